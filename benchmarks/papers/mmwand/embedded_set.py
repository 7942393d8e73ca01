"""A set of wand touches as embeddings: read once, kept on disk, so that every table is quick."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int

from benchmarks.papers.mmwand.splits import Fold, Split, split_touches
from benchmarks.real_touch.embedders import Embedder, find_embedder
from touchgoal.control.arrays import Image
from touchgoal.encoders.alignment.wand_set import WandSet
from touchgoal.encoders.ssl.frames import find_sensor_name
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.runtime.atomic_write import atomic_write
from touchgoal.runtime.progress import track

_SMALL = (40, 30)  # px of the images that pixels are compared in


@dataclass(frozen=True, eq=False)
class EmbeddedSet:
    """n touches of k objects, embedded by frozen networks."""

    names: tuple[str, ...]  # objects, sorted
    sensor: str  # of the touches
    label: Int[np.ndarray, " n"]  # object of each touch
    visit: Int[np.ndarray, " n"]  # visit of each touch
    sentences: tuple[str, ...]
    describes: Bool[np.ndarray, "k m"]  # whether sentence j is on object i
    texts: Float32[np.ndarray, "m t"]  # text tower's embeddings
    image: Float32[np.ndarray, "n v i"]  # image tower's embeddings of the v views
    touch: dict[str, Float32[np.ndarray, "n _"]]  # encoder -> touch embeddings
    pixels: Float32[np.ndarray, "n p"]  # change against the untouched gel, 40 x 30 px with its sign

    def fold(self, split: Split, seed: int) -> Fold:
        """Hold out a fifth, see `split_touches`."""
        return split_touches(split, self.label, self.visit, self.describes, seed)


def embed_set(root: Path, encoders: tuple[str, ...], seed: int, cache: Path) -> EmbeddedSet:
    """Embed the images, views and sentences of a set that `collect-touches` recorded.

    UserError: no such set or encoder, or touches without views.

    Args:
        encoders: see `find_embedder`.
        cache: folder that keeps the embeddings.
    """
    data, towers = WandSet.open(root), load_towers("offline")
    keep = partial(cached, cache, data.episodes.checksum)
    made = {name: _embed_touches(name, seed, data, keep) for name in encoders}
    return EmbeddedSet(
        names=data.names,
        sensor=find_sensor_name(None, data.episodes),
        label=data.label,
        visit=data.visit,
        sentences=data.sentences,
        describes=data.describes,
        texts=towers.embed_texts(list(data.sentences)).numpy(),
        image=keep(f"wand view {towers.name}", lambda: data.embed_views(towers)),
        touch=made,
        pixels=keep(f"pixels {_SMALL}", lambda: _pixels(data)),
    )


def _embed_touches(
    name: str, seed: int, data: WandSet, keep: Callable[[str, Callable[[], np.ndarray]], np.ndarray]
) -> Float32[np.ndarray, "n d"]:
    embed = find_embedder(name, seed)
    what = touch_key(embed, *data.images(0))
    return keep(what, lambda: data.embed_touches(embed))


def touch_key(embed: Embedder, untouched: Image, touched: Image) -> str:
    """Return a key of touch embeddings, of the first one's: an encoder's name may get new weights."""
    return f"touch {hashlib.sha256(embed(touched[None], untouched).tobytes()).hexdigest()}"


def cached(cache: Path, data: str, what: str, make: Callable[[], np.ndarray]) -> np.ndarray:
    """Return an array from the cache, or make and keep it; `data` is the checksum of a set."""
    key = hashlib.sha256(f"{what} {data}".encode()).hexdigest()[:16]
    path = cache / f"{key}.npy"
    if path.exists():
        return np.load(path)
    array = make()
    with atomic_write(path) as unfinished, unfinished.open("wb") as file:
        np.save(file, array)
    return array


def small_change(untouched: Image, touched: Image) -> Float32[np.ndarray, " p"]:
    """Return the raw pixels of a touch: its change, 40 x 30 px with its sign."""
    change = touched.astype(np.float32) - untouched
    return cv2.resize(change, _SMALL, interpolation=cv2.INTER_AREA).ravel()


def _pixels(data: WandSet) -> Float32[np.ndarray, "n d"]:
    reading = track(range(len(data)), "reading pixels", "touch")
    return np.stack([small_change(*data.images(i)) for i in reading])
