"""Touches of a grey dome and views of the same objects, embedded by frozen networks."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Int

from touchgoal.control.tactile.light_gain import remove_gain
from touchgoal.encoders.backbones.pooled_encoder import STAGES, pool_stages
from touchgoal.encoders.towers.efficientnet import EfficientNetLite0, load_efficientnet_lite0
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.episodes.importers.touch_clip import decode
from touchgoal.episodes.importers.touch_sets.vt60 import (
    DomeTouches,
    inside_dome,
    outside_dome,
    read_vt60,
)
from touchgoal.runtime.atomic_write import atomic_write
from touchgoal.runtime.progress import track

FOLDS = 4
SHIPPED, RANDOM, PIXELS, OUTSIDE = (
    "touch encoder",
    "the same, random weights",
    "raw pixels",
    "pixels outside the sensor",
)
INPUTS = (SHIPPED, RANDOM, PIXELS, OUTSIDE)
"""Touch embeddings. The last has no touch in it: what it finds comes from the session's light."""
DomeSplit = Literal["press", "object"]

# network input: side, px; batch size; its counts per count of change in the image
_SIDE, _BATCH, _CONTRAST = 192, 32, 2.0
_SMALL = 28  # px of the pictures that pixels are compared in


@dataclass(frozen=True, eq=False)
class DomeSet:
    """n touches and m views of k objects."""

    listed: DomeTouches
    touch: dict[str, Float32[np.ndarray, "n _"]]  # one of INPUTS -> embeddings
    image: Float32[np.ndarray, "m i"]  # unit embeddings of the image tower


@dataclass(frozen=True, eq=False)
class DomeFold:
    """Rows of the touches and of the views on either side."""

    train_touch: Int[np.ndarray, " a"]
    test_touch: Int[np.ndarray, " b"]
    train_view: Int[np.ndarray, " c"]
    test_view: Int[np.ndarray, " d"]


def embed_dome(folder: Path, seed: int, cache: Path) -> DomeSet:
    """Embed a set once and keep it in a cache.

    The network sees the change inside the dome alone, with a gain of the light taken out.
    UserError: see `read_vt60`.
    """
    data = read_vt60(folder)
    key = hashlib.sha256()
    for path in (data.untouched, *data.touches, *data.views):
        key.update(f"{path.relative_to(folder)} {path.stat().st_size}".encode())
    path = cache / f"dome-{key.hexdigest()[:16]}-{seed}.npz"
    if not path.exists():
        arrays = {**_embed_touches(data, seed), "image": _embed_views(data)}
        with atomic_write(path) as unfinished, unfinished.open("wb") as file:
            np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
    with np.load(path) as arrays:
        return DomeSet(data, {name: arrays[name] for name in INPUTS}, arrays["image"])


def folds(data: DomeTouches, split: DomeSplit, seed: int) -> Iterator[DomeFold]:
    """Yield four folds. "press": a quarter of every object's touches and views, at random; "object":
    a quarter of every class's objects with all their touches and views.
    """
    rng = np.random.default_rng([seed, 13])
    if split == "press":
        touch, view = (_parts(own, rng) for own in (data.touch_object, data.view_object))
    else:
        part = _parts(data.kind, None)
        touch, view = part[data.touch_object], part[data.view_object]
    for k in range(FOLDS):
        rows = (np.flatnonzero(mask) for own in (touch, view) for mask in (own != k, own == k))
        yield DomeFold(*rows)


def _parts(group: Int[np.ndarray, " n"], rng: np.random.Generator | None) -> Int[np.ndarray, " n"]:
    """Deal the members of each group to the folds in turn, shuffled by a generator."""
    part = np.empty(len(group), np.int64)
    for name in np.unique(group):
        rows = np.flatnonzero(group == name)
        part[rows if rng is None else rng.permutation(rows)] = np.arange(len(rows)) % FOLDS
    return part


def _embed_touches(data: DomeTouches, seed: int) -> dict[str, Float32[np.ndarray, "n _"]]:
    untouched = decode(data.untouched.read_bytes(), str(data.untouched)).astype(np.float32)
    inside, corners = inside_dome(*untouched.shape[:2]), outside_dome(*untouched.shape[:2])
    change, outside = [], []
    for path in track(data.touches, "reading touches", "touch"):
        picture = decode(path.read_bytes(), str(path))
        change.append((remove_gain(picture, untouched) - untouched)[inside].astype(np.float32))
        outside.append((picture - untouched)[corners].mean(1))
    return {
        SHIPPED: _pooled(change, load_efficientnet_lite0(), SHIPPED),
        RANDOM: _pooled(change, _random_network(seed), RANDOM),
        PIXELS: _stack(
            cv2.resize(c.mean(2), (_SMALL, _SMALL), interpolation=cv2.INTER_AREA).ravel()
            for c in change
        ),
        OUTSIDE: _stack(outside),
    }


def _stack(rows: Iterator[np.ndarray] | list[np.ndarray]) -> Float32[np.ndarray, "n d"]:
    return np.stack(list(rows)).astype(np.float32)


def _random_network(seed: int) -> EfficientNetLite0:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return EfficientNetLite0().eval()


def _pooled(
    change: list[Float32[np.ndarray, "h w 3"]], network: EfficientNetLite0, name: str
) -> Float32[np.ndarray, "n d"]:
    """Return what `pooled_encoder` pools from the changes."""
    rows = []
    for start in track(range(0, len(change), _BATCH), f"embedding touch, {name}", "batch"):
        batch = np.stack([cv2.resize(c, (_SIDE, _SIDE)) for c in change[start : start + _BATCH]])
        drawn = (128 + _CONTRAST * torch.from_numpy(batch).permute(0, 3, 1, 2)).clamp(0, 255) / 255
        with torch.no_grad():
            rows.append(
                pool_stages(network.stem, list(network.blocks)[: STAGES[-1][0] + 1], drawn).numpy()
            )
    return np.concatenate(rows)


def _embed_views(data: DomeTouches) -> Float32[np.ndarray, "m i"]:
    towers = load_towers("offline")
    rows = [
        towers.embed_images(decode(path.read_bytes(), str(path))[None])[0].numpy()
        for path in track(data.views, "embedding views", "view")
    ]
    image = np.stack(rows)
    return image / np.linalg.norm(image, axis=1, keepdims=True)
