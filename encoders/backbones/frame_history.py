"""Frames and earlier ones, for encoders of stacked frames or clips."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from touchgoal.control.arrays import Image
from touchgoal.encoders.backbones.vit import ViTConfig
from touchgoal.encoders.preprocess import Preprocessor


def frame_offsets(vit: ViTConfig, stride: int) -> tuple[int, ...]:
    """Return how many frames back each input frame of a ViT lies, the newest (0) first."""
    count = vit.channels // 3 if vit.tubelet == 1 else vit.frames
    return tuple(stride * k for k in range(count))


def past_rows(
    rows: Int[np.ndarray, " k"], offsets: tuple[int, ...], first: int | Int[np.ndarray, " k"] = 0
) -> Int[np.ndarray, "k t"]:
    """Return the rows of all input frames for each newest frame, newest first.

    The row `first`, at which each recording begins, stands for frames before it.
    """
    return np.maximum(rows[:, None] - np.array(offsets), np.reshape(first, (-1, 1)))


class RecentFrames:
    """Cache of the last preprocessed frames of one sensor, so that a tick preprocesses only one."""

    def __init__(self, preprocess: Preprocessor, offsets: tuple[int, ...]) -> None:
        self._preprocess, self._offsets = preprocess, offsets
        self._untouched: Image | None = None
        # by the id of a frame, which is kept so that its id stays its own
        self._known: dict[int, tuple[Image, Float[Tensor, "1 3 H W"]]] = {}

    def latest(self, history: Sequence[Image], untouched: Image) -> Float[Tensor, "1 t 3 H W"]:
        """Return the newest frame and those at the offsets before it, for an encoder's `stack`.

        The history holds the same objects from tick to tick, the oldest first, which also stands
        for frames before it.
        """
        if untouched is not self._untouched:
            self._untouched, self._known = untouched, {}
        newest = len(history) - 1
        chosen = [history[max(newest - back, 0)] for back in self._offsets]
        for frame in chosen:
            if id(frame) not in self._known:
                touch = torch.from_numpy(self._preprocess(frame[None], untouched))
                self._known[id(frame)] = frame, touch
        held = {id(frame) for frame in history}
        self._known = {key: known for key, known in self._known.items() if key in held}
        return torch.stack([self._known[id(frame)][1] for frame in chosen], 1)
