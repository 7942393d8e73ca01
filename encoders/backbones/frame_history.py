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
        self._known: list[tuple[Image, Float[Tensor, "1 3 H W"]]] = []

    def latest(self, history: Sequence[Image], untouched: Image) -> Float[Tensor, "1 t 3 H W"]:
        """Return the newest frame and those at the offsets before it, for an encoder's `stack`.

        The history holds the same objects from tick to tick, the oldest first, which also stands
        for frames before it.
        """
        if untouched is not self._untouched:
            self._untouched, self._known = untouched, []
        newest = len(history) - 1
        chosen = [self._preprocessed(history[max(newest - back, 0)]) for back in self._offsets]
        held = {id(frame) for frame in history}
        self._known = [entry for entry in self._known if id(entry[0]) in held]
        return torch.stack(chosen, 1)

    def _preprocessed(self, frame: Image) -> Float[Tensor, "1 3 H W"]:
        for known, touch in self._known:
            if known is frame:
                return touch
        assert self._untouched is not None
        touch = torch.from_numpy(self._preprocess(frame[None], self._untouched))
        self._known.append((frame, touch))
        return touch
