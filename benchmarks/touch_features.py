"""What `touch_probes` reads of two frames of a press, by a frozen encoder of any kind."""

from typing import Protocol, runtime_checkable

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float32
from torch import Tensor

from touchgoal.benchmarks.real_touch_encoders import vit_of
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder
from touchgoal.encoders.backbones.touch_backbone import BaseTouchEncoder

_PARTS = 4  # by 4 parts of a picture, besides the whole: probes ask where
_GREY, _COUNTS = 128, 16.0  # of a frame drawn from a change, in which 1.0 is a firm contact

Change = Float32[np.ndarray, "_ _ 3"]


@runtime_checkable
class PressFeatures(Protocol):
    """Features of a press.

    Attributes:
        shape: rows and columns of the changes that it takes; the rows are the field's height.
    """

    shape: tuple[int, int]

    def __call__(
        self, before: Change, now: Change
    ) -> tuple[Float32[np.ndarray, " d"], Float32[np.ndarray, " d"]]:
        """Of the press as it is now, and of what moved since the frame before."""
        ...


def press_features(encoder: BaseTouchEncoder) -> PressFeatures:
    """How an encoder sees presses; UserError for one without tokens or stages."""
    if isinstance(encoder, PooledEncoder):
        return PooledFeatures(encoder)
    return TokenFeatures(encoder)


class PooledFeatures:
    """Of an ImageNet network, pooled over a square picture and its parts."""

    shape: tuple[int, int] = (120, 120)

    def __init__(self, encoder: PooledEncoder) -> None:
        self._encoder = encoder

    @torch.no_grad()
    def __call__(
        self, before: Change, now: Change
    ) -> tuple[Float32[np.ndarray, " d"], Float32[np.ndarray, " d"]]:
        """See PressFeatures; what moved is the difference of both as a picture."""
        pictures = np.stack([now, now - before]).transpose(0, 3, 1, 2)
        touch = torch.from_numpy(np.ascontiguousarray(pictures))
        present, moved = self._encoder.pool_parts(touch).numpy()
        return present, moved


class TokenFeatures:
    """Tokens of a ViT, their mean over the picture and over its parts.

    Changes are drawn as frames about grey and go through the encoder's own preprocessor. An encoder that looks back
    sees the frames as a recording of three: untouched, before, now; there are no more, so that its stride
    does not count. For any other, what moved is the difference of both as a frame.
    """

    shape: tuple[int, int] = (240, 320)  # a sensor's own 4:3

    def __init__(self, encoder: BaseTouchEncoder) -> None:
        """UserError for an encoder without a ViT."""
        self._encoder, self._vit = encoder, vit_of(encoder)

    @torch.no_grad()
    def __call__(
        self, before: Change, now: Change
    ) -> tuple[Float32[np.ndarray, " d"], Float32[np.ndarray, " d"]]:
        """See PressFeatures."""
        encoder, back = self._encoder, len(self._encoder.offsets)
        rest = np.zeros_like(now)
        changes = [now, before, rest, rest][:back] if back > 1 else [now, now - before]
        drawn = np.clip(np.rint(_GREY + _COUNTS * np.stack(changes)), 0, 255).astype(np.uint8)
        grey = np.full(drawn.shape[1:], _GREY, np.uint8)
        touch = torch.from_numpy(encoder.preprocess(drawn, grey))
        if back > 1:
            both = self._pooled(encoder.stack(touch[None]))[0].numpy()
            return both, both
        present, moved = self._pooled(encoder.stack(touch[:, None])).numpy()
        return present, moved

    def _pooled(self, touch: Float[Tensor, "n c *t h w"]) -> Float[Tensor, "n d"]:
        size = self._vit.config.patch_size
        rows, columns = (-(-side // size) for side in touch.shape[-2:])
        tokens = self._vit(touch)
        if self._vit.class_token is not None:
            tokens = tokens[:, 1:]
        places = tokens.transpose(1, 2).unflatten(2, (-1, rows, columns)).mean(2)  # over times
        parts = F.adaptive_avg_pool2d(places, _PARTS).flatten(1)
        return torch.cat([tokens.mean(1), parts], 1)
