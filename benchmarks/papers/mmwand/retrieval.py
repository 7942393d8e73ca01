"""Cross-modal retrieval on wand touches: MMWand's Table IV, on four splits.

Every query ranks all candidates of the other modality by cosine; candidates of the same object are
right. A touch and the picture taken with it are never matched. Frozen embeddings are joined by
linear heads that are fitted on the training touches, for every encoder alike.
"""

from dataclasses import field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float

from touchgoal.benchmarks.options import BenchmarkOptions
from touchgoal.benchmarks.papers.mmwand.embedded_set import EmbeddedSet, embed_set
from touchgoal.benchmarks.papers.mmwand.real.dome_tables import run_retrieval
from touchgoal.benchmarks.papers.mmwand.splits import SPLITS, Fold, Split, split_touches
from touchgoal.encoders.alignment.config import HeadsConfig
from touchgoal.encoders.alignment.heads import Heads, Paired, fit_heads
from touchgoal.encoders.alignment.retrieval import average_precisions
from touchgoal.episodes.importers.touch_sets.vt60 import is_vt60
from touchgoal.runtime.option_types import Count, Seed, checked_dataclass

PUBLISHED = {
    "image to touch": (31.52, 27.08),
    "image to text": (43.87, 43.87),
    "touch to image": (38.71, 31.73),
    "touch to text": (52.25, 29.73),
    "text to image": (46.73, 46.73),
    "text to touch": (44.10, 22.37),
}
"""MMWand's Table IV, mAP in %: with and without the touch-text loss."""
_BOOTSTRAPS = 500

Scores = dict[str, tuple[Float[np.ndarray, "q c"], Bool[np.ndarray, "q c"]]]
"""Direction -> similarities of q queries to c candidates, and which are right."""


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark retrieval."""

    data: Path = field(kw_only=True)
    """Touches recorded by `collect-touches --body wand`, or vt60's folder (real touches of a dome, with
    which come networks of their own: of the other options only `cache` and `seed` count)."""
    encoders: tuple[str, ...] = ("gelsight_mini_surfaces", "gelsight_mini", "random:gelsight_mini")
    """Touch encoders: see benchmark real-touch."""
    splits: tuple[Split, ...] = SPLITS
    """What is held out."""
    seeds: Count = 3
    """Splits and heads of each kind, each with another seed."""
    heads: HeadsConfig = HeadsConfig()
    """Training of the heads."""
    cache: Path = Path("runs/mmwand-embeddings")
    """Folder that keeps the embeddings."""
    seed: Seed = 0
    """Random seed."""


def run(config: Config) -> dict[str, Any]:
    """Fit heads and judge retrieval, split by split."""
    if is_vt60(config.data):
        return run_retrieval(config.data, config.seed, config.cache)
    data = embed_set(config.data, config.encoders, config.seed, config.cache)
    rows = []
    for split in config.splits:
        for name, with_text in [(n, t) for n in config.encoders for t in (True, False)]:
            precisions = [
                _one(data, name, with_text, split, s, config) for s in range(config.seeds)
            ]
            rows.append(
                {"split": split, "encoder": name, "touch_text": with_text, **_summary(precisions)}
            )
        rows.append(
            {
                "split": split,
                "encoder": "raw pixels",
                "touch_text": None,
                **_pixel_row(data, split, config),
            }
        )
        rows.append(
            {
                "split": split,
                "encoder": "chance",
                "touch_text": None,
                **_chance_row(data, split, config),
            }
        )
    pool = _pools(data, config)
    return {"table": _table(rows, pool), "rows": rows, "pools": pool}


def _one(
    data: EmbeddedSet, name: str, with_text: bool, split: Split, seed: int, config: Config
) -> dict[str, list[tuple[int, float]]]:
    """Return (object, average precision) of every query, by direction."""
    fold = split_touches(split, data.label, data.visit, data.describes, seed)
    touch = F.normalize(torch.from_numpy(data.touch[name]), dim=1)
    paired = Paired(
        touch=touch[fold.train],
        label=torch.from_numpy(data.label[fold.train]),
        image=torch.from_numpy(data.image[fold.train]),
        texts=torch.from_numpy(data.texts[fold.train_text]),
        describes=torch.from_numpy(data.describes[:, fold.train_text]),
    )
    options = (
        config.heads if with_text else HeadsConfig(**{**vars(config.heads), "text_weight": 0.0})
    )
    heads = fit_heads(paired, options, seed)
    return _precisions(data, fold, touch, heads)


@torch.no_grad()
def _precisions(
    data: EmbeddedSet, fold: Fold, touch: torch.Tensor, heads: Heads
) -> dict[str, list[tuple[int, float]]]:
    query = touch[fold.test].numpy()
    image = heads.images(torch.from_numpy(data.image[fold.test])).mean(1)
    image = F.normalize(image, dim=1).numpy()
    text = heads.texts(torch.from_numpy(data.texts[fold.test_text])).numpy()
    return judge(data, fold, {"touch": query, "image": image, "text": text})


def judge(
    data: EmbeddedSet, fold: Fold, embedded: dict[str, Float[np.ndarray, "_ d"]]
) -> dict[str, list[tuple[int, float]]]:
    """Return (object, average precision) of every query of the six directions.

    Args:
        data: the set.
        fold: which of it is judged.
        embedded: unit vectors of one space: of the test touches, their pictures, the test sentences.
    """
    label = data.label[fold.test]
    describes = data.describes[:, fold.test_text]
    owner = describes.argmax(0)
    of_object = {"touch": label, "image": label, "text": owner}
    same, own = label[:, None] == label, np.eye(len(label), dtype=bool)
    on = describes[label]
    right = {"touch image": same & ~own, "touch text": on, "image text": on}
    found = {}
    for pair, relevant in right.items():
        first, second = pair.split()
        similarity = embedded[first] @ embedded[second].T
        if pair == "touch image":
            similarity = np.where(own, -np.inf, similarity)
        for one, other, s, r in (
            (first, second, similarity, relevant),
            (second, first, similarity.T, relevant.T),
        ):
            asked = r.any(1)
            precision = average_precisions(s[asked], r[asked])
            found[f"{one} to {other}"] = list(
                zip(of_object[one][asked].tolist(), precision.tolist(), strict=True)
            )
    return found


def _pixel_row(data: EmbeddedSet, split: Split, config: Config) -> dict[str, Any]:
    """Judge the nearest training touch in raw pixels: its picture and its object's sentences stand for it."""
    found = []
    for seed in range(config.seeds):
        fold = split_touches(split, data.label, data.visit, data.describes, seed)
        pixels = data.pixels / np.linalg.norm(data.pixels, axis=1, keepdims=True)
        nearest = fold.train[(pixels[fold.test] @ pixels[fold.train].T).argmax(1)]
        image = data.image.mean(1)
        image = image / np.linalg.norm(image, axis=1, keepdims=True)
        texts = data.texts / np.linalg.norm(data.texts, axis=1, keepdims=True)
        of_nearest = np.stack(
            [texts[data.describes[k] & fold.train_text].mean(0) for k in data.label[nearest]]
        )
        by_image = judge(
            data,
            fold,
            {
                "touch": image[nearest],
                "image": image[fold.test],
                "text": np.zeros((fold.test_text.sum(), image.shape[1])),
            },
        )
        by_text = judge(
            data,
            fold,
            {
                "touch": of_nearest,
                "image": np.zeros((len(fold.test), texts.shape[1])),
                "text": texts[fold.test_text],
            },
        )
        found.append(
            {d: by_image[d] for d in ("touch to image", "image to touch")}
            | {d: by_text[d] for d in ("touch to text", "text to touch")}
        )
    return _summary(found)


def _chance_row(data: EmbeddedSet, split: Split, config: Config) -> dict[str, Any]:
    found = []
    for seed in range(config.seeds):
        fold = split_touches(split, data.label, data.visit, data.describes, seed)
        n, m = len(fold.test), int(fold.test_text.sum())
        found.append(
            judge(
                data,
                fold,
                {"touch": np.zeros((n, 1)), "image": np.zeros((n, 1)), "text": np.zeros((m, 1))},
            )
        )
    return _summary(found)


def _summary(found: list[dict[str, list[tuple[int, float]]]]) -> dict[str, Any]:
    """Return mAP (%) and its 95 % interval by direction: seeds averaged, objects resampled."""
    summary, rng = {}, np.random.default_rng(0)
    for direction in found[0]:
        pairs = [pair for one in found for pair in one[direction]]
        if not pairs:  # no object has two touches to find each other
            continue
        objects, value = (np.array(column) for column in zip(*pairs, strict=True))
        kinds, index = np.unique(objects, return_inverse=True)
        total, count = np.bincount(index, value), np.bincount(index)
        drawn = rng.integers(len(kinds), size=(_BOOTSTRAPS, len(kinds)))
        means = total[drawn].sum(1) / count[drawn].sum(1)
        low, high = np.percentile(means, [2.5, 97.5])
        summary[direction] = [100 * float(v) for v in (value.mean(), low, high)]
    return summary


def _pools(data: EmbeddedSet, config: Config) -> dict[str, dict[str, int]]:
    pools = {}
    for split in config.splits:
        fold = split_touches(split, data.label, data.visit, data.describes, 0)
        kinds = len(np.unique(data.label[fold.test]))
        pools[split] = {
            "train": len(fold.train),
            "test": len(fold.test),
            "sentences": int(fold.test_text.sum()),
            "objects": kinds,
        }
    return pools


def _table(rows: list[dict[str, Any]], pools: dict[str, dict[str, int]]) -> str:
    lines = [
        "mAP in %, mean over seeds [95 % over objects]; published: MMWand, Table IV, split by sample",
        "",
    ]
    for split, pool in pools.items():
        lines.append(
            f"split by {split}: {pool['train']} touches to train on; {pool['test']} touches and pictures of "
            f"{pool['objects']} objects, {pool['sentences']} sentences to find"
        )
        lines.append(f"{'':<40}" + "".join(f"{d:>22}" for d in PUBLISHED))
        if split == "sample":
            for i, what in enumerate(("published", "published, without touch-text")):
                lines.append(f"{what:<40}" + "".join(f"{v[i]:>22.2f}" for v in PUBLISHED.values()))
        for row in (r for r in rows if r["split"] == split):
            name = row["encoder"] + (", without touch-text" if row["touch_text"] is False else "")
            cells = [
                f"{'{:.1f} [{:.1f}, {:.1f}]'.format(*row[d]):>22}" if d in row else f"{'':>22}"
                for d in PUBLISHED
            ]
            lines.append(f"{name:<40}" + "".join(cells))
        lines.append("")
    return "\n".join(lines)
