"""Touches drawn from recordings of others, as `frames` draws them from episodes."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import UInt8

from touchgoal.encoders.backbones.frame_history import past_rows
from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.encoders.ssl.frames import TouchFrames
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
