"""Frames and those before them, as encoders of two stacked frames or of clips take them."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from touchgoal.encoders.backbones.vit import ViTConfig
from touchgoal.encoders.preprocess import Preprocessor

Frame = UInt8[np.ndarray, "h w 3"]


def frame_offsets(vit: ViTConfig, stride: int) -> tuple[int, ...]:
    """How many frames before the newest lies each that a ViT sees, the newest first."""
    count = vit.channels // 3 if vit.tubelet == 1 else vit.frames
    return tuple(stride * k for k in range(count))


def past_rows(
    rows: Int[np.ndarray, " k"], offsets: tuple[int, ...], first: int | Int[np.ndarray, " k"] = 0
) -> Int[np.ndarray, "k t"]:
    """Rows of the frames that are seen together with each of some, the newest first.

    Args:
        rows: Of the newest frames, in the order of recording.
        offsets: Of an encoder.
        first: Row at which the recording begins, of each: it stands for frames before it.
    """
    return np.maximum(rows[:, None] - np.array(offsets), np.reshape(first, (-1, 1)))


def stack_frames(
    frames: Float[Tensor, "n t 3 h w"], vit: ViTConfig
) -> Float[Tensor, "n c *clip h w"]:
    """Frames, the newest first, as channels of one picture, or as a clip for a ViT with tubelets."""
    return frames.flatten(1, 2) if vit.tubelet == 1 else frames.transpose(1, 2)


class RecentFrames:
    """The last frames of one sensor, preprocessed once: what a tick of control costs beside the network."""

    def __init__(self, preprocess: Preprocessor, offsets: tuple[int, ...]) -> None:
        """For an encoder, of which these are."""
        self._preprocess, self._offsets = preprocess, offsets
        self._untouched: Frame | None = None
        self._known: list[tuple[Frame, Float[Tensor, "1 3 H W"]]] = []

    def latest(self, seen: Sequence[Frame], untouched: Frame) -> Float[Tensor, "1 t 3 H W"]:
        """The newest frame and those at the offsets before it, for an encoder's `stack`.

        Args:
            seen: Frames of the last ticks, oldest first; the same objects from tick to tick. Where
                they do not reach back far enough, the oldest stands for those before.
            untouched: The sensor untouched.
        """
        if untouched is not self._untouched:
            self._untouched, self._known = untouched, []
        newest = len(seen) - 1
        chosen = [self._preprocessed(seen[max(newest - back, 0)]) for back in self._offsets]
        held = {id(frame) for frame in seen}
        self._known = [entry for entry in self._known if id(entry[0]) in held]
        return torch.stack(chosen, 1)

    def _preprocessed(self, frame: Frame) -> Float[Tensor, "1 3 H W"]:
        for known, touch in self._known:
            if known is frame:
                return touch
        assert self._untouched is not None
        touch = torch.from_numpy(self._preprocess(frame[None], self._untouched))
        self._known.append((frame, touch))
        return touch
