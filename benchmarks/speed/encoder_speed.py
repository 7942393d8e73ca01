"""Touch embeddings a second on one core (Sparsh, Table 3).

Each ViT is compared with a peer, a `torch.nn.TransformerEncoder` of the same size, timed alternately
with and without torch's fused inference; the faster one counts. A tick is the time from a raw frame to
its embedding.
"""

import copy
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Annotated, Any, Literal, get_args

import numpy as np
import torch
from pydantic import Field
from torch import nn

from benchmarks.options import BenchmarkOptions
from benchmarks.real_touch.embedders import vit_of
from benchmarks.speed.rates import in_turn, one_core
from benchmarks.speed.reward_parts import parts_table, time_parts
from touchgoal.encoders.backbones.frame_history import RecentFrames
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder
from touchgoal.encoders.backbones.sparsh import SPARSH_BASE
from touchgoal.encoders.backbones.sparsh_input import SPARSH
from touchgoal.encoders.backbones.touch_backbone import (
    BaseTouchEncoder,
    TouchBackbone,
    TouchBackboneConfig,
)
from touchgoal.encoders.backbones.vit import ViTConfig
from touchgoal.encoders.pretrained import load_encoder
from touchgoal.encoders.published import STRIDES
from touchgoal.runtime.option_types import RARE, Count, checked_dataclass
from touchgoal.runtime.progress import track

Precision = Literal["fp32", "bf16"]
SparshShape = Literal["mae-tiny", "mae-small", "mae-base", "dino-base", "ijepa-base", "vjepa-base"]


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark encoder-speed."""

    encoders: tuple[str, ...] = ("gelsight_mini", "gelsight_mini_markers")
    """Touch encoders: a name, a folder, or a published Sparsh file or id."""
    shapes: tuple[SparshShape, ...] = get_args(SparshShape)
    """Sparsh's networks with random weights: base as published, tiny and small narrower."""
    precisions: Annotated[tuple[Precision, ...], Field(min_length=1)] = get_args(Precision)
    """Number formats of the networks."""
    batch_size: Count = 8
    """Frames in a batch."""
    repeats: Count = 5
    """Measurements of each figure; the median is printed."""
    ticks: Annotated[Count, RARE] = 5
    """Single frames in each measurement."""


_SIZES = {"tiny": (192, 3), "small": (384, 6), "base": (768, 12)}  # width, heads
_DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16}
_FRAME = 240, 320  # px, of a sensor
_STREAM = 16  # distinct frames
_PAPER = "MAE 104, DINO 112, I-JEPA 112, V-JEPA 60"  # frames/s of the base presets, Table 3


@dataclass(frozen=True)
class EncoderSpeed:
    """One encoder at one precision; ratios are None without a peer."""

    encoder: str
    parameters: float  # millions
    precision: str
    batched: float  # frames a second in batches of prepared input
    batched_ratio: float | None  # the same over the peer's
    tick: float  # ms from a raw frame to its embedding, with cached preprocessing
    tick_uncached: float  # the same without the cache
    tick_ratio: float | None  # the peer's time over `tick`


def run(config: Config) -> dict[str, Any]:
    """Time everything on one core, in processor time, which other processes distort least."""
    encoders = {name: load_encoder(name).eval() for name in config.encoders}
    encoders |= {f"Sparsh {name}, random": _random(name) for name in config.shapes}
    measured = [
        (name, precision)
        for name, encoder in encoders.items()
        for precision in config.precisions
        if precision == "fp32" or not isinstance(encoder, PooledEncoder)
    ]
    with one_core():
        rows = [
            _measure(name, encoders[name], precision, config)
            for name, precision in track(measured, "timing", "encoder")
        ]
        parts = time_parts(config.repeats)
    table = f"{_table(rows, config)}\n\n{parts_table(parts)}"
    return {"table": table, "rows": [asdict(row) for row in rows], "reward_parts": parts}


def _random(name: str) -> TouchBackbone:
    method, size = name.split("-")
    width, heads = _SIZES[size]
    vit = replace(SPARSH_BASE[method], width=width, heads=heads)
    stride = STRIDES["clip" if vit.tubelet > 1 else "pair"]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return TouchBackbone(TouchBackboneConfig(vit, None, SPARSH, stride)).eval()


@torch.inference_mode()
def _measure(name: str, encoder: BaseTouchEncoder, precision: str, config: Config) -> EncoderSpeed:
    dtype = _DTYPES[precision]
    plain = None
    if not isinstance(encoder, PooledEncoder):
        plain = _Peer(vit_of(encoder).config).eval().to(dtype)
        encoder = copy.deepcopy(encoder).to(dtype)
    stream = _Stream(encoder, dtype)
    batch = (
        stream.uncached()
        .expand(config.batch_size, *[-1] * (stream.uncached().ndim - 1))
        .contiguous()
    )
    batched: list[Callable[[], object]] = [lambda: encoder.embed_touch(batch)]
    ticks: list[Callable[[], object]] = [
        lambda: encoder.embed_touch(stream.cached()),
        lambda: encoder.embed_touch(stream.uncached()),
    ]
    if plain is not None:
        batched += [partial(_plainly, plain, lambda: batch, fused) for fused in (True, False)]
        ticks += [partial(_plainly, plain, stream.uncached, fused) for fused in (True, False)]
    ours, *peer = in_turn(batched, config.repeats)
    cached, uncached, *peers_tick = in_turn(ticks, config.repeats * config.ticks)
    return EncoderSpeed(
        encoder=name,
        parameters=sum(p.numel() for p in encoder.parameters()) / 1e6,
        precision=precision,
        batched=config.batch_size / ours,
        batched_ratio=min(peer) / ours if peer else None,
        tick=1e3 * cached,
        tick_uncached=1e3 * uncached,
        tick_ratio=min(peers_tick) / cached if peers_tick else None,
    )


def _plainly(plain: nn.Module, make: Callable[[], torch.Tensor], fused: bool) -> torch.Tensor:
    before = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(fused)
    try:
        return plain(make()).mean(1)
    finally:
        torch.backends.mha.set_fastpath_enabled(before)


class _Peer(nn.Module):
    """A ViT of the same size from torch's own layers, with random weights."""

    def __init__(self, config: ViTConfig) -> None:
        super().__init__()
        patch = (config.patch_size, config.patch_size)
        clip = (config.tubelet, *patch)
        self.patch = (
            nn.Conv2d(config.channels, config.width, patch, patch)
            if config.tubelet == 1
            else nn.Conv3d(config.channels, config.width, clip, clip)
        )
        hidden = round(config.mlp_ratio * config.width)
        like_ours: dict[str, Any] = {"dropout": 0.0, "activation": "gelu", "norm_first": True}
        layer = nn.TransformerEncoderLayer(
            config.width, config.heads, hidden, batch_first=True, **like_ours
        )
        self.blocks = nn.TransformerEncoder(layer, config.depth, enable_nested_tensor=False)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return self.blocks(self.patch(images).flatten(2).transpose(1, 2))


class _Stream:
    def __init__(self, encoder: BaseTouchEncoder, dtype: torch.dtype) -> None:
        drawn = np.random.default_rng(0).integers(90, 130, (_STREAM, *_FRAME, 3), np.uint8)
        self._frames = [frame.copy() for frame in drawn]
        self._encoder, self._dtype, self._newest = encoder, dtype, 0
        self._recent = RecentFrames(encoder.preprocess, encoder.offsets)

    def cached(self) -> torch.Tensor:
        """Return the next frame's input with cached preprocessing."""
        self._newest += 1
        back = max(self._encoder.offsets)
        frames = [self._frames[(self._newest - k) % _STREAM] for k in range(back, -1, -1)]
        return self._stacked(self._recent.latest(frames, self._frames[0]))

    def uncached(self) -> torch.Tensor:
        """Return the next frame's input with everything preprocessed."""
        self._newest += 1
        rows = [(self._newest - back) % _STREAM for back in self._encoder.offsets]
        touch = self._encoder.preprocess(
            np.stack([self._frames[row] for row in rows]), self._frames[0]
        )
        return self._stacked(torch.from_numpy(touch)[None])

    def _stacked(self, touch: torch.Tensor) -> torch.Tensor:
        return self._encoder.stack(touch).to(self._dtype)


def _table(rows: list[EncoderSpeed], config: Config) -> str:
    lines = [
        f"one core, processor time, medians; in batches of {config.batch_size}, and one raw frame at a time with the earlier ones'",
        "preprocessing cached (in brackets: uncached); ratio: plain torch's time for the same over ours",
        f"{'encoder':<30}{'M par.':>8}{'':>6}{'frames/s':>10}{'ratio':>7}{'ms a frame':>20}{'ratio':>7}",
    ]
    lines += [
        f"{row.encoder[-29:]:<30}{row.parameters:>8.2f}{row.precision:>6}{row.batched:>10.1f}"
        f"{_ratio(row.batched_ratio)}{row.tick:>11.2f}{f'({row.tick_uncached:.2f})':>9}{_ratio(row.tick_ratio)}"
        for row in rows
    ]
    lines.append(
        f"the paper's base encoders, on hardware that it does not name, frames/s: {_PAPER}"
    )
    return "\n".join(lines)


def _ratio(value: float | None) -> str:
    return f"{'-' if value is None else f'{value:.2f}':>7}"
