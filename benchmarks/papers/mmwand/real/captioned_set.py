"""TVL's captioned touches (Fu et al. 2024) as embeddings, for MMWand's Table IV.

A caption stands for an object: touches with the same one are right for each other.
"""

import hashlib
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from benchmarks.papers.mmwand.embedded_set import EmbeddedSet, cached, small_change, touch_key
from benchmarks.published_touch.tvl import CaptionedTouch, read_tvl
from benchmarks.real_touch.embedders import Embedder, find_embedder
from touchgoal.control.arrays import Image
from touchgoal.encoders.towers.towers import Towers, load_towers
from touchgoal.episodes.importers.touch_clip import decode
from touchgoal.runtime.progress import track

_MEDIAN_OF = 50  # touches; enough that no pixel is touched in most of them


def embed_captioned(root: Path, encoders: tuple[str, ...], seed: int, cache: Path) -> EmbeddedSet:
    """Embed TVL once and keep it in a cache; UserError: see `read_tvl`, or no such encoder."""
    touches, towers = read_tvl(root), load_towers("offline")
    untouched = _median(touches)
    names, label = np.unique([", ".join(t.words) for t in touches], return_inverse=True)
    _, press = np.unique([t.press for t in touches], return_inverse=True)
    files = [f"{t.touch.relative_to(root)} {t.touch.stat().st_size}" for t in touches]
    keep = partial(cached, cache, hashlib.sha256("\n".join(files).encode()).hexdigest())
    made = {}
    for name in encoders:
        embed = find_embedder(name, seed)
        what = touch_key(embed, *_images(touches[0], untouched))
        made[name] = keep(what, lambda embed=embed: _embed(touches, untouched, embed))
    return EmbeddedSet(
        names=tuple(names.tolist()),
        sensor="digit",
        label=label,
        visit=press,
        sentences=tuple(names.tolist()),
        describes=np.eye(len(names), dtype=bool),
        texts=towers.embed_texts(names.tolist()).numpy(),
        image=keep(f"view {towers.name}", lambda: _embed_views(touches, towers)),
        touch=made,
        pixels=keep("pixels", lambda: _pixels(touches, untouched)),
    )


def _median(touches: list[CaptionedTouch]) -> Image:
    """Return the median image of touches of SSVTP, which has no untouched one, or of any others."""
    own = [touch for touch in touches if touch.untouched is None] or touches
    some = own[:: max(1, len(own) // _MEDIAN_OF)]
    images = np.stack([_image(touch.touch) for touch in some])
    return np.median(images, axis=0).astype(np.uint8)


def _images(touch: CaptionedTouch, untouched: Image) -> tuple[Image, Image]:
    """Return the untouched and the touched image, RGB."""
    own = _image(touch.untouched) if touch.untouched else untouched
    return own, _image(touch.touch)


def _image(path: Path) -> Image:
    return decode(path.read_bytes(), str(path))


def _embed(
    touches: list[CaptionedTouch], untouched: Image, embed: Embedder
) -> Float32[np.ndarray, "n d"]:
    rows = []
    for touch in track(touches, "embedding touches", "touch"):
        own, touched = _images(touch, untouched)
        rows.append(embed(touched[None], own)[0])
    return np.stack(rows).astype(np.float32)


def _pixels(touches: list[CaptionedTouch], untouched: Image) -> Float32[np.ndarray, "n d"]:
    reading = track(touches, "reading pixels", "touch")
    return np.stack([small_change(*_images(touch, untouched)) for touch in reading])


def _embed_views(touches: list[CaptionedTouch], towers: Towers) -> Float32[np.ndarray, "n 1 i"]:
    return np.stack(
        [
            towers.embed_images(_image(touch.image)[None]).numpy()
            for touch in track(touches, "embedding views", "view")
        ]
    )
