"""Objects of a set recorded with another sensor, by candidate sentences: MMWand's Table III on wand touches.

As in the paper, an encoder is trained on that set or on the first one, and a touch chooses among the
sentences of a few objects, its own among them. A fifth of the objects is left out of every training.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int

from benchmarks.papers.mmwand.embedded_set import EmbeddedSet, embed_set
from benchmarks.papers.mmwand.intervals import Interval, cell, mean_over_objects
from touchgoal.encoders.alignment.config import HeadsConfig
from touchgoal.encoders.alignment.heads import Heads, PairedEmbeddings, fit_heads
from touchgoal.rewards.report.tables import aligned
from touchgoal.runtime.errors import UserError

PUBLISHED = """published (MMWand, Table III, VisGel), top-1 and top-5 in %, seen / unseen objects:
  images                      53.95  93.49  /   9.97  48.52
  touch, trained on VisGel    14.58  65.20  /  13.83  60.54
  touch, trained on MMWand     7.38  50.08  /  11.79  51.02"""
CANDIDATES = 10
"""Sentences that a touch chooses among; the paper's number, the instances in an image, is not published."""

Cells = dict[str, Interval]


def run_other_set(
    data: Path, other: Path, encoders: Sequence[str], heads: HeadsConfig, seeds: int, cache: Path
) -> dict[str, Any]:
    """Judge touches of `data` by heads trained on it and on `other`.

    UserError: the sets have other objects, or are of the same sensor.

    Args:
        data: touches of the wand, another sensor's.
        other: touches of the same objects.
        encoders: touch encoders, frozen, see `find_embedder`; each reads both sensors.
        seeds: number of divisions of the objects.
        cache: folder that keeps the embeddings.
    """
    judged, first = (embed_set(root, tuple(encoders), 0, cache) for root in (data, other))
    if judged.names != first.names or judged.sentences != first.sentences:
        raise UserError(f"{data} and {other} hold other objects: record both by collect-touches")
    if judged.sensor == first.sensor:
        raise UserError(
            f"{data} and {other} are both of {first.sensor}: record one with another sensor"
        )
    hits: dict[str, dict[str, list[np.ndarray]]] = {}
    for seed in range(seeds):
        seen = _seen_objects(judged, seed)
        for name in encoders:
            for trained_on in (judged, first):
                what = f"{name}, trained on {trained_on.sensor}"
                rows = _training_rows(trained_on, seen, seed)
                fitted = _fit(trained_on, rows, name, seen, heads, seed)
                touch = F.normalize(torch.from_numpy(judged.touch[name]), dim=1)
                _count(hits.setdefault(what, {}), touch, fitted, judged, seen, seed)
                if trained_on is judged and name == encoders[0]:
                    image = fitted.image(torch.from_numpy(judged.image)).mean(1).detach()
                    _count(hits.setdefault("images", {}), image, fitted, judged, seen, seed)
    rows = [
        {"row": what, **{k: mean_over_objects(*_joined(v)) for k, v in found.items()}}
        for what, found in hits.items()
    ]
    return {"table": _table(rows, len(judged.names)), "rows": rows}


def _seen_objects(data: EmbeddedSet, seed: int) -> Bool[np.ndarray, " k"]:
    fold = data.fold("object", seed)
    return np.isin(np.arange(len(data.names)), data.label[fold.train])


def _training_rows(
    data: EmbeddedSet, seen: Bool[np.ndarray, " k"], seed: int
) -> Int[np.ndarray, " r"]:
    """Return the touches of seen objects on the training side of whole visits."""
    fold = data.fold("press", seed)
    return fold.train[seen[data.label[fold.train]]]


def _fit(
    data: EmbeddedSet,
    rows: Int[np.ndarray, " r"],
    name: str,
    seen: Bool[np.ndarray, " k"],
    config: HeadsConfig,
    seed: int,
) -> Heads:
    paired = PairedEmbeddings(
        touch=F.normalize(torch.from_numpy(data.touch[name][rows]), dim=1),
        label=torch.from_numpy(data.label[rows]),
        image=torch.from_numpy(data.image[rows]),
        texts=torch.from_numpy(data.texts),
        describes=torch.from_numpy(data.describes & seen[:, None]),
    )
    return fit_heads(paired, config, seed)


def _count(
    hits: dict[str, list[np.ndarray]],
    embedded: Float[torch.Tensor, "n d"],
    heads: Heads,
    data: EmbeddedSet,
    seen: Bool[np.ndarray, " k"],
    seed: int,
) -> None:
    """Add, by column of the table, the object and the hit of each touch that is judged."""
    texts = heads.text(torch.from_numpy(data.texts)).detach()
    similarity = (F.normalize(embedded, dim=1) @ texts.T).numpy()
    held_out = data.fold("press", seed).test
    rng = np.random.default_rng([seed, 7])
    every = np.arange(len(data.label))
    for column, kept, judged in (("seen", seen, held_out), ("unseen", ~seen, every)):
        rows = judged[kept[data.label[judged]]]
        rank = np.array([_rank(similarity[i], data, kept, int(data.label[i]), rng) for i in rows])
        for top in (1, 5):
            hits.setdefault(f"{column} top-{top}", []).append(
                np.stack([data.label[rows], (rank < top).astype(float)])
            )


def _rank(
    similarity: Float[np.ndarray, " m"],
    data: EmbeddedSet,
    kept: Bool[np.ndarray, " k"],
    own: int,
    rng: np.random.Generator,
) -> int:
    """Return how many candidates are nearer than a sentence on the touched object."""
    others = rng.permutation([k for k in np.flatnonzero(kept) if k != own])[: CANDIDATES - 1]
    sentences = [rng.choice(np.flatnonzero(data.describes[k])) for k in (own, *others)]
    return int((similarity[sentences[1:]] >= similarity[sentences[0]]).sum())


def _joined(pieces: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    objects, hit = np.concatenate(pieces, axis=1)
    return objects.astype(int), hit


def _table(rows: list[dict[str, Any]], objects: int) -> str:
    columns = [f"{c} top-{k}" for c in ("seen", "unseen") for k in (1, 5)]
    title = (
        f"own sentence among {CANDIDATES} objects', % [95 % over objects], {objects} objects, seen ones on "
        f"visits held out; chance {100 / CANDIDATES:.0f} and {500 / CANDIDATES:.0f}"
    )
    cells = [["", *columns], *([r["row"], *(cell(r[c]) for c in columns)] for r in rows)]
    return "\n".join([title, *aligned(cells), "", PUBLISHED])
