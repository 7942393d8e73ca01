"""Four ways to hold touches out, from the easiest to the hardest.

The MMWand paper splits by sample: the same objects, presses of the same minute and the same
sentences are on both sides, so a nearest neighbour in raw pixels scores high (RCT, arXiv
2606.31694, found that it explains most published figures).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Int

from touchgoal.encoders.alignment.wand_set import draw_held_out

Split = Literal["sample", "press", "object", "sentence"]
SPLITS: tuple[Split, ...] = ("sample", "press", "object", "sentence")


@dataclass(frozen=True, eq=False)
class Fold:
    """Training and test side of a split."""

    # train, test: rows of the touches
    train: Int[np.ndarray, " a"]
    test: Int[np.ndarray, " b"]
    # train_text, test_text: whether each sentence is on that side
    train_text: Bool[np.ndarray, " m"]
    test_text: Bool[np.ndarray, " m"]


def split_touches(
    split: Split,
    label: Int[np.ndarray, " n"],
    visit: Int[np.ndarray, " n"],
    describes: Bool[np.ndarray, "k m"],
    seed: int,
) -> Fold:
    """Hold out a fifth.

    Args:
        split: "sample": touches at random. "press": whole visits, in which an object is pressed
            several times with one gel. "object": whole objects with their sentences. "sentence":
            touches at random, and one sentence per object; only these sentences are tested.
        label: object of each touch.
        visit: visit of each touch.
        describes: whether sentence j is on object i.
    """
    rng, every = np.random.default_rng([seed, 11]), np.ones(describes.shape[1], bool)
    if split == "object":
        out = draw_held_out(rng, np.unique(label))
        test = np.isin(label, out)
        held = describes[out].sum(0) > 0
        return Fold(np.flatnonzero(~test), np.flatnonzero(test), ~held, held)
    if split == "press":
        test = np.isin(visit, draw_held_out(rng, np.unique(visit)))
    else:
        test = np.isin(np.arange(len(label)), draw_held_out(rng, np.arange(len(label))))
    if split == "sentence":
        held = np.zeros(describes.shape[1], bool)
        held[[rng.choice(np.flatnonzero(row)) for row in describes]] = True
        return Fold(np.flatnonzero(~test), np.flatnonzero(test), ~held, held)
    return Fold(np.flatnonzero(~test), np.flatnonzero(test), every, every)
