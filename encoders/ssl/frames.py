"""Training data without labels: touches drawn from episodes and recordings, preprocessed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float16, Int
from torch import Tensor

from touchgoal.control.features import TACTILE, TRUTH_PAD_WRENCH
from touchgoal.encoders.backbones.frame_history import past_rows
from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.episodes.faults import leave_out_faulty
from touchgoal.episodes.importers.labelled_videos import LabelledVideo
from touchgoal.episodes.importers.pretraining_clips import Recording as ClipRecording
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

Recording = ClipRecording | LabelledVideo
"""One fingertip's images in a file, and the untouched sensor."""


@dataclass(frozen=True, eq=False)
class TouchFrames:
    """n touches."""

    # preprocessed frames in half precision, to save memory; the t frames of a sample, newest first
    touch: Float16[Tensor, "n t 3 h w"]
    # simulated wrench on each pad (N, Nm, pad frame), for probes only; None if not recorded
    wrench: Float[Tensor, "n 6"] | None
    sensor: str  # name of the fingertip sensor
    stride: int = 1  # ticks between the frames of a sample

    @classmethod
    def joined(cls, parts: list["TouchFrames"]) -> "TouchFrames":
        """Join touches of one sensor and stride; wrenches only if every part has them."""
        wrenches = [part.wrench for part in parts if part.wrench is not None]
        wrench = torch.cat(wrenches) if len(wrenches) == len(parts) else None
        first = parts[0]
        return cls(torch.cat([part.touch for part in parts]), wrench, first.sensor, first.stride)

    def __len__(self) -> int:
        return len(self.touch)


def sample_frames(
    episodes: EpisodeSet,
    sensor: str,
    per_episode: int,
    seed: int,
    offsets: tuple[int, ...] = (0,),
) -> TouchFrames:
    """Draw ticks at random from every episode, with every fingertip of each.

    The background is a fingertip's first frame: episodes start untouched. The first frame also
    stands for frames before it, as it does when a policy acts. Faulty episodes are left out and
    listed. UserError: no touch in the set, or another sensor's.

    Args:
        per_episode: Ticks drawn from each episode; all of a shorter one.
        seed: Random seed; an episode's draw does not depend on the other episodes.
        offsets: Ticks from the drawn frame back to each frame of a sample, 0 first.
    """
    sides = {side: key for side, key in enumerate(TACTILE) if key in episodes.features}
    if not sides:
        raise UserError(f"{episodes.root} has no {' and no '.join(TACTILE)}: record touch")
    keys = list(sides.values())
    preprocess = preprocessor_for(sensor)
    truth = [TRUTH_PAD_WRENCH] if TRUTH_PAD_WRENCH in episodes.features else []
    touch, wrench = [], []
    sound = leave_out_faulty(episodes, range(len(episodes)), keys)
    for i in track(sound, "touches", "episode"):
        check_sensor(episodes, i, sensor)
        ticks, rows, where = _draw_rows(episodes.lengths[i], per_episode, [seed, i], offsets)
        frames = episodes.read(i, keys, rows).frames
        first = episodes.read(i, keys, [0]).frames
        forces = episodes.read(i, truth, ticks.tolist()).frames
        for side, key in sides.items():
            touch.append(torch.from_numpy(preprocess(frames[key], first[key][0])).half()[where])
            for name in truth:
                wrench.append(torch.from_numpy(forces[name][:, 6 * side : 6 * side + 6]))
    known = torch.cat(wrench) if truth else None
    return TouchFrames(torch.cat(touch), known, sensor, _stride(offsets))


def sample_recordings(
    recordings: Sequence[Recording],
    per_recording: int,
    seed: int,
    offsets: tuple[int, ...] = (0,),
) -> TouchFrames:
    """Draw images at random from recordings of one sensor, at least one; see `sample_frames`.

    A recording's draw does not depend on later ones. UserError: an image is broken, or not of the
    sensor's shape.
    """
    sensor = recordings[0].sensor
    preprocess = preprocessor_for(sensor)
    touch = []
    for i, recording in enumerate(track(recordings, "touches", "recording")):
        clip, background = recording.open()
        _, rows, where = _draw_rows(len(clip), per_recording, [seed, i], offsets)
        frames = clip[rows] if isinstance(clip, np.ndarray) else clip.frames(rows)
        touch.append(torch.from_numpy(preprocess(frames, background)).half()[where])
    return TouchFrames(torch.cat(touch), None, sensor, _stride(offsets))


def _stride(offsets: tuple[int, ...]) -> int:
    return offsets[1] if len(offsets) > 1 else 1


def _draw_rows(
    length: int, count: int, seed: list[int], offsets: tuple[int, ...]
) -> tuple[Int[np.ndarray, " k"], list[int], Int[Tensor, "k t"]]:
    """Return the drawn rows, all rows to read for them, and where among these each frame is."""
    drawn = np.sort(np.random.default_rng(seed).permutation(length)[:count])
    rows, where = np.unique(past_rows(drawn, offsets), return_inverse=True)
    return drawn, rows.tolist(), torch.from_numpy(where.reshape(len(drawn), -1))


def find_sensor_name(sensor: str | None, *sets: EpisodeSet) -> str:
    """Return the fingertip sensor of all episodes; `sensor` is that of those that do not name theirs.

    UserError: unknown, not named, or not the same in all episodes.
    """
    sensor = sensor or str(sets[0].meta(0).get("sensor", ""))
    if not sensor:
        raise UserError(f"{sets[0].root} does not name its fingertip sensor: name it with --sensor")
    preprocessor_for(sensor)
    for episodes in sets:
        for i in range(len(episodes)):
            check_sensor(episodes, i, sensor)
    return sensor


def check_sensor(episodes: EpisodeSet, i: int, sensor: str) -> None:
    """Raise UserError if an episode names another sensor."""
    recorded = episodes.meta(i).get("sensor", sensor)
    if recorded != sensor:
        raise UserError(
            f"episode {i} of {episodes.root} was recorded with {recorded}, not {sensor}: name that "
            "sensor, or record with this one"
        )
