"""Weights of training windows by the progress that they make, where demonstrations differ in quality.

Reward-aligned behaviour cloning (RA-BC) of SARM (Chen et al. 2025, arXiv:2509.25358, eq. 8 and 9),
as lerobot computes it: windows with progress count in full, windows that lose progress not at all.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float, Float32

from touchgoal.runtime.errors import UserError

_IN_FULL = 0.01  # progress above which a window counts in full: kappa of RA-BC


def read_progress(path: Path, chosen: Sequence[int], lengths: Sequence[int]) -> list[np.ndarray]:
    """Read the progress of each frame of some episodes, in [0, 1].

    `path` is the `touchgoal_progress.parquet` that reward-curves wrote for these episodes, or
    another reward model's file in LeRobot's layout. UserError: no such file, or not of these
    episodes.
    """
    try:
        table = pq.read_table(path, columns=["episode_index", "frame_index", "progress_sparse"])
    except (OSError, KeyError, pa.ArrowInvalid) as error:
        raise UserError(f"{path} holds no progress: give one of reward-curves") from error
    episode, frame, value = (column.to_numpy() for column in table.columns)
    progress = []
    for i, length in zip(chosen, lengths, strict=True):
        own = episode == i
        if not np.array_equal(frame[own], np.arange(length)):
            raise UserError(
                f"{path} does not have the {length} frames of episode {i}: measure this set again"
            )
        progress.append(value[own])
    return progress


def progress_weights(
    progress: Sequence[Float[np.ndarray, " _"]], ahead: int
) -> Float32[np.ndarray, " n"]:
    """Return a weight in [0, 1] for every frame of some episodes, one after the other.

    The weight follows from the progress in the next `ahead` frames, or until the episode's end. An
    episode's last frame has none, because no action follows it. UserError: nothing makes progress.
    """
    later = [np.minimum(np.arange(len(p)) + ahead, len(p) - 1) for p in progress]
    gain = np.concatenate([p[to] - p for p, to in zip(progress, later, strict=True)])
    mean, spread = max(gain.mean(), 0.0), max(gain.std(), 1e-6)
    weights = np.clip((gain - mean + 2 * spread) / (4 * spread), 0, 1)
    weights[gain > _IN_FULL] = 1
    weights[gain < 0] = 0
    weights[np.cumsum([len(p) for p in progress]) - 1] = 0
    if not weights.any():
        raise UserError(
            "no frame of --data makes progress: leave out --progress, or check its goal"
        )
    return weights.astype(np.float32)
