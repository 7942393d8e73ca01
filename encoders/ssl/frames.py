"""What self-supervision trains on: touches drawn from episodes, preprocessed, without labels."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Float16, UInt8
from torch import Tensor

from touchgoal.control.features import TACTILE, TRUTH_PAD_WRENCH
from touchgoal.encoders.backbones.frame_history import past_rows
from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track


@runtime_checkable  # beartype checks arguments in tests
class Clip(Protocol):
    """Pictures in time."""

    def __len__(self) -> int: ...  # noqa: D105
    def frames(self, rows: Sequence[int]) -> UInt8[np.ndarray, "n h w 3"]: ...  # noqa: D102


@runtime_checkable
class Recorded(Protocol):
    """One fingertip's pictures in a file, and the sensor untouched."""

    @property
    def sensor(self) -> str: ...  # noqa: D102
    @property
    def held_out(self) -> bool: ...  # noqa: D102
    def open(self) -> tuple["Clip", UInt8[np.ndarray, "h w 3"]]: ...  # noqa: D102


@dataclass(frozen=True, eq=False)
class TouchFrames:
    """n touches.

    Attributes:
        touch: Preprocessed frames; half precision, for they fill the memory. Of an objective that sees
            several at once a moment's frames, the newest first.
        wrench: What the simulator says acts on each pad (N, Nm, pad frame), for probes only;
            None if the episodes do not say.
        sensor: Name of the fingertip sensor.
        stride: Ticks from one of a moment's frames to the one before.
    """

    touch: Float16[Tensor, "n *t 3 h w"]
    wrench: Float[Tensor, "n 6"] | None
    sensor: str
    stride: int = 1

    @classmethod
    def of_moments(
        cls,
        moments: list[Float16[Tensor, "_ t 3 h w"]],
        wrench: Float[Tensor, "n 6"] | None,
        sensor: str,
        offsets: tuple[int, ...] | None,
    ) -> "TouchFrames":
        """Of the frames of drawn moments, newest first; see `sample_frames` for `offsets`."""
        touch = torch.cat(moments)
        stride = offsets[1] if offsets and len(offsets) > 1 else 1
        return cls(touch if offsets else touch[:, 0], wrench, sensor, stride)

    @classmethod
    def joined(cls, parts: list["TouchFrames"]) -> "TouchFrames":
        """All touches of one sensor and stride; forces are known only if they are of every part."""
        wrenches = [part.wrench for part in parts if part.wrench is not None]
        wrench = torch.cat(wrenches) if len(wrenches) == len(parts) else None
        first = parts[0]
        return cls(torch.cat([part.touch for part in parts]), wrench, first.sensor, first.stride)

    def __len__(self) -> int:
        """Number of touches."""
        return len(self.touch)


def sample_frames(
    episodes: EpisodeSet,
    sensor: str,
    per_episode: int,
    seed: int,
    offsets: tuple[int, ...] | None = None,
) -> TouchFrames:
    """Draws ticks at random from every episode, and takes every fingertip of each.

    The background is a fingertip's first frame: episodes start untouched. For frames before an
    episode's first, that one stands, as it does when a policy acts: nothing has touched or moved yet.

    Args:
        episodes: A set with touch.
        sensor: Name of the fingertip sensor.
        per_episode: Ticks drawn from each episode; all of a shorter one.
        seed: Of the draw; an episode's draw does not depend on the other episodes.
        offsets: How many ticks before a drawn one each frame lies that is seen with it, the drawn one's
            0 first; None for single frames.

    Raises:
        UserError: No touch in the set, or another sensor's.
    """
    sides = {side: key for side, key in enumerate(TACTILE) if key in episodes.features}
    if not sides:
        raise UserError(f"{episodes.root} has no {' and no '.join(TACTILE)}: record touch")
    keys = list(sides.values())
    preprocess = preprocessor_for(sensor)
    truth = [TRUTH_PAD_WRENCH] if TRUTH_PAD_WRENCH in episodes.features else []
    touch, wrench = [], []
    for i in track(range(len(episodes)), "touches", "episode"):
        check_sensor(episodes, i, sensor)
        rng = np.random.default_rng([seed, i])
        ticks = np.sort(rng.permutation(episodes.lengths[i])[:per_episode])
        seen, where = np.unique(past_rows(ticks, offsets or (0,)), return_inverse=True)
        frames = episodes.read(i, keys, seen.tolist()).frames
        first = episodes.read(i, keys, [0]).frames
        known = episodes.read(i, truth, ticks.tolist()).frames
        for side, key in sides.items():
            rows = torch.from_numpy(preprocess(frames[key], first[key][0])).half()
            touch.append(rows[torch.from_numpy(where.reshape(len(ticks), -1))])
            for name in truth:
                wrench.append(torch.from_numpy(known[name][:, 6 * side : 6 * side + 6]))
    return TouchFrames.of_moments(touch, torch.cat(wrench) if truth else None, sensor, offsets)


def sample_recordings(
    recordings: Sequence[Recorded],
    per_recording: int,
    seed: int,
    offsets: tuple[int, ...] | None = None,
) -> TouchFrames:
    """Draws pictures at random from every recording.

    Args:
        recordings: Of one sensor, one at least.
        per_recording: Pictures drawn from each; all of a shorter one.
        seed: Of the draw; a recording's draw does not depend on how many there are after it.
        offsets: As in `frames.sample_frames`.

    Raises:
        UserError: A picture is broken, or not of the sensor's shape.
    """
    sensor = recordings[0].sensor
    preprocess = preprocessor_for(sensor)
    touch = []
    for i, recording in enumerate(track(recordings, "touches", "recording")):
        rng = np.random.default_rng([seed, i])
        clip, background = recording.open()
        drawn = np.sort(rng.permutation(len(clip))[:per_recording])
        seen, where = np.unique(past_rows(drawn, offsets or (0,)), return_inverse=True)
        rows = preprocess(clip.frames(seen.tolist()), background)
        touch.append(torch.from_numpy(rows).half()[torch.from_numpy(where.reshape(len(drawn), -1))])
    return TouchFrames.of_moments(touch, None, sensor, offsets)


def check_sensor(episodes: EpisodeSet, i: int, sensor: str) -> None:
    """Raises UserError if an episode says that it was recorded with another sensor."""
    felt = episodes.meta(i).get("sensor", sensor)
    if felt != sensor:
        raise UserError(
            f"episode {i} of {episodes.root} was recorded with {felt}, not {sensor}: name that sensor, "
            "or record with this one"
        )
