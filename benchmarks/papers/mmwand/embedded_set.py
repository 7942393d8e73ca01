"""A set of wand touches as embeddings: read once, kept on disk, so that every table is quick."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from touchgoal.benchmarks.real_touch.embedders import find_embedder
from touchgoal.control import features as ft
from touchgoal.encoders.towers.towers import Towers, load_towers
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.atomic_write import atomic_write
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

_SMALL = (40, 30)  # px of the pictures that pixels are compared in


@dataclass(frozen=True, eq=False)
class EmbeddedSet:
    """n touches of k objects.

    Attributes:
        names: objects, sorted.
        label, visit: object and visit of each touch.
        sentences: all of them.
        describes: whether sentence j is on object i.
        texts: text tower's embeddings.
        image: image tower's embeddings of the v views before contact.
        touch: encoder -> touch embeddings.
        pixels: change against the untouched gel, 40 x 30 px with its sign.
    """

    names: tuple[str, ...]
    label: Int[np.ndarray, " n"]
    visit: Int[np.ndarray, " n"]
    sentences: tuple[str, ...]
    describes: Bool[np.ndarray, "k m"]
    texts: Float32[np.ndarray, "m t"]
    image: Float32[np.ndarray, "n v i"]
    touch: dict[str, Float32[np.ndarray, "n _"]]
    pixels: Float32[np.ndarray, "n p"]


def embed_set(root: Path, encoders: tuple[str, ...], seed: int, cache: Path) -> EmbeddedSet:
    """Embed the pressed and untouched pictures, the views and the sentences of a set.

    Args:
        root: set that `collect-touches` recorded.
        encoders: see `find_embedder`.
        seed: of random weights.
        cache: folder that keeps the embeddings.

    Raises:
        UserError: no such set or encoder, or touches without views.
    """
    episodes = EpisodeSet(root)
    if not len(episodes) or ft.WAND_VIEWS[0] not in episodes.features:
        raise UserError(
            f"{root} holds no touches with views: record with collect-touches --body wand"
        )
    meta = [episodes.meta(i) for i in range(len(episodes))]
    names = tuple(sorted({str(m["object"]) for m in meta}))
    of = {str(m["object"]): list(m["descriptions"]) for m in meta}  # pyright: ignore[reportArgumentType]
    sentences = tuple(sorted({s for name in names for s in of[name]}))
    towers = load_towers("offline")
    touch = {
        name: _kept(
            cache, episodes, f"touch {name} {seed}", lambda n=name: _touches(episodes, n, seed)
        )
        for name in encoders
    }
    return EmbeddedSet(
        names=names,
        label=np.array([names.index(str(m["object"])) for m in meta]),
        visit=np.array([int(m["visit"]) for m in meta]),  # pyright: ignore[reportArgumentType]
        sentences=sentences,
        describes=np.array([[s in of[name] for s in sentences] for name in names]),
        texts=towers.embed_texts(list(sentences)).numpy(),
        image=_kept(cache, episodes, f"views {towers.name}", lambda: _views(episodes, towers)),
        touch=touch,
        pixels=_kept(cache, episodes, f"pixels {_SMALL}", lambda: _pixels(episodes)),
    )


def touch_pictures(
    episodes: EpisodeSet, i: int
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 3"]]:
    """Return the untouched and the firmest picture of a touch."""
    frames = episodes.read(i, [ft.TACTILE_LEFT], [0, episodes.lengths[i] - 1]).frames
    untouched, touched = frames[ft.TACTILE_LEFT]
    return untouched, touched


def _kept(
    cache: Path, episodes: EpisodeSet, what: str, make: Callable[[], np.ndarray]
) -> np.ndarray:
    """Return an array from the cache, or make and keep it."""
    key = hashlib.sha256(f"{what} {episodes.checksum}".encode()).hexdigest()[:16]
    path = cache / f"{key}.npy"
    if path.exists():
        return np.load(path)
    array = make()
    with atomic_write(path) as unfinished, unfinished.open("wb") as file:
        np.save(file, array)
    return array


def _touches(episodes: EpisodeSet, name: str, seed: int) -> Float32[np.ndarray, "n d"]:
    embed = find_embedder(name, seed)
    rows = []
    for i in track(range(len(episodes)), f"embedding touch, {name}", "touch"):
        untouched, touched = touch_pictures(episodes, i)
        rows.append(embed(touched[None], untouched)[0])
    return np.stack(rows).astype(np.float32)


def _views(episodes: EpisodeSet, towers: Towers) -> Float32[np.ndarray, "n v i"]:
    rows = []
    for i in track(range(len(episodes)), "embedding views", "touch"):
        frames = episodes.read(i, list(ft.WAND_VIEWS), [0]).frames
        rows.append(towers.embed_images(np.concatenate([frames[key] for key in ft.WAND_VIEWS])))
    return np.stack([row.numpy() for row in rows])


def _pixels(episodes: EpisodeSet) -> Float32[np.ndarray, "n d"]:
    rows = []
    for i in track(range(len(episodes)), "reading pixels", "touch"):
        untouched, touched = touch_pictures(episodes, i)
        change = touched.astype(np.float32) - untouched
        rows.append(cv2.resize(change, _SMALL, interpolation=cv2.INTER_AREA).ravel())
    return np.stack(rows)
