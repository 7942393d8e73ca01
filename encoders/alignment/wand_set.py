"""Touches by the wand, read as training data: images, views, objects and sentences."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int

from touchgoal.control import features as ft
from touchgoal.control.arrays import Image, Images
from touchgoal.encoders.towers.towers import Towers
from touchgoal.episodes.format.joined import load_episodes
from touchgoal.episodes.store import EpisodeSet
from touchgoal.episodes.touches import Touches, descriptions
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

_TEST_SHARE = 1048 / 5182  # MMWand's share of test touches


def is_wand_set(root: Path, keys: Mapping[str, str] | None = None) -> bool:
    """Whether a folder holds touches of the wand; UserError if it holds no set.

    See `load_episodes`.
    """
    episodes = load_episodes(root, keys)
    return bool(len(episodes)) and ft.WAND_VIEWS[0] in episodes.features


@dataclass(frozen=True, eq=False)
class WandSet:
    """n touches of k objects on which there are m sentences."""

    episodes: EpisodeSet  # one touch each
    names: tuple[str, ...]  # objects, sorted
    label: Int[np.ndarray, " n"]  # object of each touch
    visit: Int[np.ndarray, " n"]  # visit of each touch, see `episodes.wand.recording`
    sentences: tuple[str, ...]  # sorted
    describes: Bool[np.ndarray, "k m"]  # whether sentence j is on object i

    @classmethod
    def open(cls, root: Path) -> "WandSet":
        """Open a set; UserError if it was not recorded by `collect-touches --body wand`."""
        if not is_wand_set(root):
            raise UserError(
                f"{root} holds no touches with views: record with collect-touches --body wand"
            )
        episodes = load_episodes(root)
        meta = [episodes.meta(i) for i in range(len(episodes))]
        of = descriptions(episodes)
        names, sentences = sorted(of), sorted({s for own in of.values() for s in own})
        return cls(
            episodes=episodes,
            names=tuple(names),
            label=np.array([names.index(str(m["object"])) for m in meta]),
            visit=np.array([int(str(m["visit"])) for m in meta]),
            sentences=tuple(sentences),
            describes=np.array([[s in of[name] for s in sentences] for name in names]),
        )

    def __len__(self) -> int:
        return len(self.label)

    def hold_out_visits(self, seed: int) -> tuple[Int[np.ndarray, " a"], Int[np.ndarray, " b"]]:
        """Return rows to train on, and those of a fifth of the visits to test on."""
        rng = np.random.default_rng([seed, 11])
        test = np.isin(self.visit, draw_held_out(rng, np.unique(self.visit)))
        return np.flatnonzero(~test), np.flatnonzero(test)

    def images(self, i: int) -> tuple[Image, Image]:
        """Return the untouched and the firmest image of a touch, RGB."""
        last = self.episodes.lengths[i] - 1
        untouched, touched = self.episodes.read(i, [ft.TACTILE_LEFT], [0, last]).frames[
            ft.TACTILE_LEFT
        ]
        return untouched, touched

    def view(self, i: int) -> Image:
        """Return the wand's own view before contact, RGB."""
        return self.episodes.read(i, [ft.WAND_VIEWS[-1]], [0]).frames[ft.WAND_VIEWS[-1]][0]

    def touches(self, rows: Int[np.ndarray, " r"]) -> Touches:
        """Return the firmest images of some touches, with their views, as training data. Slow."""
        reading = track(rows, "reading touches", "touch", len(rows))
        images = [(*self.images(int(i)), self.view(int(i))) for i in reading]
        untouched, touched, views = (np.stack(kind) for kind in zip(*images, strict=True))
        index = np.arange(len(rows))
        objects = tuple(self.names[i] for i in self.label[rows])
        sentences = self.sentences_by_object()
        return Touches(touched, untouched, index, views, index, objects, sentences)

    def sentences_by_object(self) -> dict[str, list[str]]:
        """Return the sentences on each object."""
        return {
            name: [s for s, on in zip(self.sentences, own, strict=True) if on]
            for name, own in zip(self.names, self.describes, strict=True)
        }

    def embed_touches(
        self, embed: Callable[[Images, Image], Float32[np.ndarray, "_ d"]]
    ) -> Float32[np.ndarray, "n d"]:
        """Embed the firmest images by a function of images and their untouched one. Slow."""
        rows = []
        for i in track(range(len(self)), "embedding touches", "touch"):
            untouched, touched = self.images(i)
            rows.append(embed(touched[None], untouched)[0])
        return np.stack(rows).astype(np.float32)

    def embed_views(
        self, towers: Towers, change: Callable[[Image], Image] = lambda view: view
    ) -> Float32[np.ndarray, "n 1 i"]:
        """Embed the wand's own view before contact, which shows the place to be touched.

        Each view is changed first; embeddings are not normalised. Slow.
        """
        rows = [
            towers.embed_images(change(self.view(i))[None])
            for i in track(range(len(self)), "embedding views", "touch")
        ]
        return torch.stack(rows).numpy()


def draw_held_out(rng: np.random.Generator, items: Int[np.ndarray, " n"]) -> Int[np.ndarray, " k"]:
    """Draw MMWand's share of the items to test on."""
    return rng.permutation(items)[: round(_TEST_SHARE * len(items))]
