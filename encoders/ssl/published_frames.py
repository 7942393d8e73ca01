"""Touches drawn from published recordings, as `frames` draws them from episodes."""

from collections.abc import Sequence

import numpy as np
import torch

from touchgoal.control.progress import track
from touchgoal.encoders.backbones.frame_history import past_rows
from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.encoders.ssl.frames import TouchFrames
from touchgoal.episodes.importers.pretraining_clips import Recording


def sample_recordings(
    recordings: Sequence[Recording],
    per_recording: int,
    seed: int,
    offsets: tuple[int, ...] | None = None,
) -> TouchFrames:
    """Draws pictures at random from every recording; only these are decoded.

    Args:
        recordings: Of one sensor, one at least.
        per_recording: Pictures drawn from each; all of a shorter one.
        seed: Of the draw; a recording's draw does not depend on how many there are after it.
        offsets: As in `frames.sample_frames`.

    Raises:
        UserError: A picture is broken, or not of the sensor's shape.
    """
    sensor = recordings[0].clip.sensor
    preprocess = preprocessor_for(sensor)
    touch = []
    for i, recording in enumerate(track(recordings, "touches", "recording")):
        rng = np.random.default_rng([seed, i])
        drawn = np.sort(rng.permutation(len(recording.clip))[:per_recording])
        seen, where = np.unique(past_rows(drawn, offsets or (0,)), return_inverse=True)
        rows = preprocess(recording.clip.frames(seen), recording.background())
        touch.append(torch.from_numpy(rows).half()[torch.from_numpy(where.reshape(len(drawn), -1))])
    return TouchFrames.of_moments(touch, None, sensor, offsets)
