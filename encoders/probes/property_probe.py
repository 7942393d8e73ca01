"""What an embedding knows of the things that were touched: who is who, and how they feel.

Videos are samples, things are what generalises: intervals are over things.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped

from touchgoal.encoders.probes.ridge import ridge_scores
from touchgoal.encoders.text_head import EmbedTexts, fit_text_head, rank_sentences
from touchgoal.encoders.whitening import inverse_square_root, within_classes

STRENGTHS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
N_RANKS = 3
_FOLDS = 10
_BOOTSTRAPS = 1000
_SHRINKAGE = 0.6  # of the videos' covariance; 0.6 to 0.98 tell things apart alike

Things = Shaped[np.ndarray, " n"]


@dataclass(frozen=True)
class PropertyReading:
    """Ranks read out of embeddings of things that the probe has not seen.

    Attributes:
        right: whether each property of each video is.
        scores: expected rank, 0 to 2.
        strength: of the ridge.
    """

    right: Bool[np.ndarray, "n properties"]
    scores: Float[np.ndarray, "n properties"]
    strength: float

    @property
    def all_right(self) -> Bool[np.ndarray, " n"]:
        """Whether all properties of a video are right."""
        return np.asarray(self.right.all(1))


def nearest_is_same(embeddings: Float[np.ndarray, "n d"], things: Things) -> Bool[np.ndarray, " n"]:
    """Whether the nearest other video, by cosine, is of the same thing."""
    unit = embeddings / np.maximum(np.linalg.norm(embeddings, axis=1, keepdims=True), 1e-12)
    similarity = unit @ unit.T
    np.fill_diagonal(similarity, -np.inf)
    return np.asarray(things[similarity.argmax(1)] == things)


def adapted_nearest_is_same(
    embeddings: Float[np.ndarray, "n d"], things: Things
) -> Bool[np.ndarray, " n"]:
    """As `nearest_is_same`, centred and whitened by videos of other things: what a user's own data add."""
    right = np.zeros(len(things), bool)
    for test, adapted in _adapted(embeddings, things):
        right[test] = nearest_is_same(adapted, things)[test]
    return right


def sentences_right(
    embeddings: Float[np.ndarray, "n d"],
    ranks: Int[np.ndarray, "n properties"],
    things: Things,
    embed_texts: EmbedTexts,
) -> Bool[np.ndarray, "n properties"]:
    """Whether the nearest of the three sentences on a property is true.

    Sentences are brought to touch by other things, by which embeddings are adapted, too.
    """
    right = np.zeros(ranks.shape, bool)
    for test, adapted in _adapted(embeddings, things):
        touches = torch.from_numpy(adapted)
        touches = touches / touches.norm(dim=1, keepdim=True).clamp_min(1e-12)
        head = fit_text_head(touches[~test], torch.from_numpy(ranks[~test]), embed_texts)
        for k in range(ranks.shape[1]):
            goals = head(embed_texts(rank_sentences(k))).double()
            right[test, k] = (touches[test] @ goals.T).argmax(1).numpy() == ranks[test, k]
    return right


def read_properties(
    embeddings: Float[np.ndarray, "n d"],
    ranks: Int[np.ndarray, "n properties"],
    train: Bool[np.ndarray, " n"],
    test: Bool[np.ndarray, " n"],
) -> PropertyReading:
    """Fit a ridge on some things and read others; its strength is the best on the others."""
    readings = [_read(embeddings, ranks, train, test, strength) for strength in STRENGTHS]
    return max(readings, key=_quality)


def cross_validated(
    embeddings: Float[np.ndarray, "n d"], ranks: Int[np.ndarray, "n properties"], things: Things
) -> PropertyReading:
    """Every thing read by a probe that was fitted to nine tenths of the others."""
    readings = []
    for strength in STRENGTHS:
        right = np.zeros(ranks.shape, bool)
        scores = np.zeros(ranks.shape)
        for test in _folds(things):
            part = _read(embeddings, ranks, ~test, test, strength)
            right[test], scores[test] = part.right, part.scores
        readings.append(PropertyReading(right, scores, strength))
    return max(readings, key=_quality)


def pair_accuracy(
    scores: Float[np.ndarray, " n"], ranks: Int[np.ndarray, " n"], things: Things
) -> float:
    """Of two things, is the first more so, less so or the same (PC of Octopi)?"""
    one, other = np.triu_indices(len(ranks), 1)
    different = things[one] != things[other]
    one, other = one[different], other[different]
    if not len(one):
        return float("nan")
    read = np.rint(scores).clip(0, N_RANKS - 1)
    return float((np.sign(read[one] - read[other]) == np.sign(ranks[one] - ranks[other])).mean())


def most_of_three(
    scores: Float[np.ndarray, " n"],
    ranks: Int[np.ndarray, " n"],
    things: Things,
    rng: np.random.Generator,
) -> float:
    """Which of three things is most so (PSS of Octopi); over 2000 draws with one right answer."""
    hits = []
    for _ in range(20_000):
        three = rng.choice(len(ranks), 3, replace=False)
        best = ranks[three] == ranks[three].max()
        if best.sum() == 1 and len(set(things[three])) == 3:
            hits.append(scores[three].argmax() == best.argmax())
        if len(hits) == 2000:
            break
    return float(np.mean(hits)) if hits else float("nan")


def interval(
    values: Bool[np.ndarray, "n ..."] | Float[np.ndarray, "n ..."],
    things: Things,
    statistic: Callable[[np.ndarray], float] = lambda v: float(np.mean(v)),
) -> tuple[float, float]:
    """95 % bootstrap interval over things, not videos."""
    rng, names = np.random.default_rng(0), np.unique(things)
    rows = {name: np.flatnonzero(things == name) for name in names}
    drawn = [
        statistic(values[np.concatenate([rows[n] for n in rng.choice(names, len(names))])])
        for _ in range(_BOOTSTRAPS)
    ]
    low, high = np.quantile(drawn, [0.025, 0.975])
    return float(low), float(high)


def _adapted(
    embeddings: Float[np.ndarray, "n d"], things: Things
) -> Iterator[tuple[Bool[np.ndarray, " n"], Float[np.ndarray, "n d"]]]:
    """Which videos are a fold's, and all of them centred and whitened by the others."""
    for test in _folds(things):
        known = embeddings[~test]
        whitening = inverse_square_root(within_classes(known, things[~test]), _SHRINKAGE)
        yield test, (embeddings - known.mean(0)) @ whitening


def _folds(things: Things) -> Iterator[Bool[np.ndarray, " n"]]:
    """The videos of a tenth of the things, all tenths in turn."""
    names = np.random.default_rng(0).permutation(np.unique(things))
    for fold in range(_FOLDS):
        test = np.isin(things, names[fold::_FOLDS])
        if test.any():
            yield test


def _read(
    embeddings: np.ndarray, ranks: np.ndarray, train: np.ndarray, test: np.ndarray, strength: float
) -> PropertyReading:
    right, scores = [], []
    for k in range(ranks.shape[1]):
        wanted = np.eye(N_RANKS)[ranks[train, k]]
        read = ridge_scores(embeddings[train], wanted, embeddings[test], strength)
        right.append(read.argmax(1) == ranks[test, k])
        scores.append(read @ np.arange(N_RANKS))
    return PropertyReading(np.stack(right, 1), np.stack(scores, 1), strength)


def _quality(reading: PropertyReading) -> float:
    return float(reading.right.mean() + reading.all_right.mean())
