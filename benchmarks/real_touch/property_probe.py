"""Object identity and material properties read from touch embeddings, by folds over objects."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped

from benchmarks.bootstrap import percentile_interval
from touchgoal.encoders.whitening.covariance import inverse_square_root, within_classes
from touchgoal.encoders.whitening.text_head import EmbedTexts, fit_text_head, rank_sentences

STRENGTHS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
N_RANKS = 3
_FOLDS = 10
_BOOTSTRAPS = 1000
_SHRINKAGE = 0.6  # share of a sphere in the within-object covariance; 0.6 to 0.98 do as well

Objects = Shaped[np.ndarray, " n"]


@dataclass(frozen=True)
class PropertyPrediction:
    """Ranks of unseen objects' properties."""

    ranks: Int[np.ndarray, "n properties"]  # most probable rank of each property, 0 to 2
    scores: Float[np.ndarray, "n properties"]  # expected rank


def nearest_is_same(
    embeddings: Float[np.ndarray, "n d"], objects: Objects
) -> Bool[np.ndarray, " n"]:
    """Return whether the nearest other video, by cosine, shows the same object."""
    unit = embeddings / np.maximum(np.linalg.norm(embeddings, axis=1, keepdims=True), 1e-12)
    similarity = unit @ unit.T
    np.fill_diagonal(similarity, -np.inf)
    return np.asarray(objects[similarity.argmax(1)] == objects)


def adapted_nearest_is_same(
    embeddings: Float[np.ndarray, "n d"], objects: Objects
) -> Bool[np.ndarray, " n"]:
    """Return `nearest_is_same` after centring and whitening with other objects' videos."""
    right = np.zeros(len(objects), bool)
    for test, adapted in _adapted(embeddings, objects):
        right[test] = nearest_is_same(adapted, objects)[test]
    return right


def sentences_right(
    embeddings: Float[np.ndarray, "n d"],
    ranks: Int[np.ndarray, "n properties"],
    objects: Objects,
    embed_texts: EmbedTexts,
) -> Bool[np.ndarray, "n properties"]:
    """Return whether the nearest of a property's three sentences is true.

    Text head and whitening are fitted to other objects.
    """
    right = np.zeros(ranks.shape, bool)
    for test, adapted in _adapted(embeddings, objects):
        touches = torch.from_numpy(adapted)
        touches = touches / touches.norm(dim=1, keepdim=True).clamp_min(1e-12)
        head = fit_text_head(touches[~test], torch.from_numpy(ranks[~test]), embed_texts)
        for k in range(ranks.shape[1]):
            goals = head(embed_texts(rank_sentences(k))).double()
            right[test, k] = (touches[test] @ goals.T).argmax(1).numpy() == ranks[test, k]
    return right


def predict_properties(
    embeddings: Float[np.ndarray, "n d"], ranks: Int[np.ndarray, "n properties"], objects: Objects
) -> PropertyPrediction:
    """Predict each object's properties with a ridge fitted to other objects, in ten folds.

    The ridge's strength is chosen by folds within the training objects, never on the judged ones.
    """
    scores = np.zeros((*ranks.shape, N_RANKS))
    for test in folds(objects):
        known = embeddings[~test], ranks[~test], objects[~test]
        scores[test] = _ridge(*known[:2], embeddings[test], _choose_strength(*known))
    return PropertyPrediction(scores.argmax(2), scores @ np.arange(N_RANKS))


def pair_accuracy(
    predicted: Int[np.ndarray, " n"], ranks: Int[np.ndarray, " n"], objects: Objects
) -> float:
    """Return how often a pair of objects is rightly called more, less or equal (PC of Octopi)."""
    one, other = np.triu_indices(len(ranks), 1)
    different = objects[one] != objects[other]
    one, other = one[different], other[different]
    if not len(one):
        return float("nan")
    right = np.sign(predicted[one] - predicted[other]) == np.sign(ranks[one] - ranks[other])
    return float(right.mean())


def most_of_three(
    scores: Float[np.ndarray, " n"],
    ranks: Int[np.ndarray, " n"],
    objects: Objects,
    rng: np.random.Generator,
) -> float:
    """Return how often the object with most of a property is found among three (PSS of Octopi).

    Uses up to 2000 draws with a single right answer.
    """
    hits = []
    for _ in range(20_000):
        three = rng.choice(len(ranks), 3, replace=False)
        best = ranks[three] == ranks[three].max()
        if best.sum() == 1 and len(set(objects[three])) == 3:
            hits.append(scores[three].argmax() == best.argmax())
        if len(hits) == 2000:
            break
    return float(np.mean(hits)) if hits else float("nan")


def interval(
    values: Bool[np.ndarray, "n ..."] | Float[np.ndarray, "n ..."],
    objects: Objects,
    statistic: Callable[[np.ndarray], float] = lambda v: float(np.mean(v)),
) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of a statistic over objects."""
    rng, names = np.random.default_rng(0), np.unique(objects)
    rows = {name: np.flatnonzero(objects == name) for name in names}
    drawn = [
        statistic(values[np.concatenate([rows[n] for n in rng.choice(names, len(names))])])
        for _ in range(_BOOTSTRAPS)
    ]
    return percentile_interval(drawn)


def _adapted(
    embeddings: Float[np.ndarray, "n d"], objects: Objects
) -> Iterator[tuple[Bool[np.ndarray, " n"], Float[np.ndarray, "n d"]]]:
    """Yield each fold and all videos, centred and whitened by the other folds."""
    for test in folds(objects):
        known = embeddings[~test]
        whitening = inverse_square_root(within_classes(known, objects[~test]), _SHRINKAGE)
        yield test, (embeddings - known.mean(0)) @ whitening


def folds(objects: Objects) -> Iterator[Bool[np.ndarray, " n"]]:
    """Yield the videos of each tenth of the objects."""
    names = np.random.default_rng(0).permutation(np.unique(objects))
    for fold in range(_FOLDS):
        test = np.isin(objects, names[fold::_FOLDS])
        if test.any():
            yield test


def _choose_strength(embeddings: np.ndarray, ranks: np.ndarray, objects: np.ndarray) -> float:
    right = dict.fromkeys(STRENGTHS, 0)
    for test in folds(objects):
        for strength in STRENGTHS:
            scores = _ridge(embeddings[~test], ranks[~test], embeddings[test], strength)
            right[strength] += int((scores.argmax(2) == ranks[test]).sum())
    return max(STRENGTHS, key=lambda strength: right[strength])


def _ridge(
    embeddings: np.ndarray, ranks: np.ndarray, test_embeddings: np.ndarray, strength: float
) -> Float[np.ndarray, "m properties ranks"]:
    """Return a score for each rank of each property."""
    targets = np.eye(N_RANKS)[ranks].reshape(len(ranks), -1)
    scores = ridge_scores(embeddings, targets, test_embeddings, strength)
    return scores.reshape(len(test_embeddings), ranks.shape[1], N_RANKS)


def ridge_scores(
    inputs: Float[np.ndarray, "n d"],
    targets: Float[np.ndarray, "n k"],
    test_inputs: Float[np.ndarray, "m d"],
    strength: float,
) -> Float[np.ndarray, "m k"]:
    """Predict targets by a ridge in its dual form, for fewer samples than columns.

    Columns are brought to variance 1; `strength` is relative to the mean square of their rows.
    """
    mean, spread = inputs.mean(0), inputs.std(0) + 1e-6
    known = (inputs - mean) / spread
    kernel, width = known @ known.T / known.shape[1], len(known)
    offset = targets.mean(0)
    weights = np.linalg.solve(kernel + strength * np.eye(width), targets - offset)
    return ((test_inputs - mean) / spread) @ known.T / known.shape[1] @ weights + offset
