"""Cross-modal retrieval on wand touches: MMWand's Table IV, on four splits.

Every query ranks all candidates of the other modality by cosine; candidates of the same object are
right. A touch and the image taken with it are never matched. For every encoder, linear heads
fitted on the training touches map images and sentences to its frozen embeddings; `--trained` adds
touch backbones that are trained on the same touches, as in the paper.
"""

from collections.abc import Callable
from dataclasses import field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int

from benchmarks.options import BenchmarkOptions
from benchmarks.papers.mmwand.embedded_set import EmbeddedSet, embed_set
from benchmarks.papers.mmwand.intervals import Interval, cell, mean_over_objects
from benchmarks.papers.mmwand.real.captioned_set import embed_captioned
from benchmarks.papers.mmwand.splits import SPLITS, Fold, Split
from benchmarks.papers.mmwand.trained import Trainable, embed_fold, read_touch_data, train
from benchmarks.published_touch.tvl import is_tvl
from touchgoal.encoders.alignment.config import AlignConfig, HeadsConfig
from touchgoal.encoders.alignment.data import TouchData
from touchgoal.encoders.alignment.heads import PairedEmbeddings, fit_heads
from touchgoal.encoders.alignment.retrieval import average_precisions
from touchgoal.encoders.alignment.wand_set import WandSet
from touchgoal.encoders.towers.towers import Towers, load_towers
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.encoders.training.trainer import check_device
from touchgoal.rewards.report.tables import aligned
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Count, Seed, checked_dataclass
from touchgoal.runtime.progress import track

PUBLISHED = {
    "image to touch": (31.52, 27.08),
    "image to text": (43.87, 43.87),
    "touch to image": (38.71, 31.73),
    "touch to text": (52.25, 29.73),
    "text to image": (46.73, 46.73),
    "text to touch": (44.10, 22.37),
}
"""MMWand's Table IV, mAP in %: with and without the touch-text loss."""


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark retrieval."""

    data: Path = field(kw_only=True)
    """Touches recorded by `collect-touches --body wand`; or TVL's folder, with ssvtp/ or hct/ (real
    touches of a DIGIT; its captions stand for objects)."""
    encoders: tuple[str, ...] = ("gelsight_mini", "random:gelsight_mini")
    """Touch encoders: see benchmark real-touch."""
    splits: tuple[Split, ...] = SPLITS
    """Units held out: single touches (sample), visits (press), objects or sentences."""
    seeds: Count = 3
    """Splits and heads of each kind, each with another seed."""
    heads: HeadsConfig = HeadsConfig()
    """Training of the heads."""
    trained: tuple[Trainable, ...] = ()
    """Touch backbones to train on each split's touches, with and without the touch-text loss, one seed
    each; slow."""
    epochs: Count = 20
    """Passes of their training over the touches."""
    device: str = "cpu"
    """Device of their training, as torch names it: cpu, cuda."""
    cache: Path = Path("runs/mmwand-embeddings")
    """Folder that keeps the embeddings."""
    seed: Seed = 0
    """Random seed of untrained weights."""


Found = dict[str, tuple[Int[np.ndarray, " q"], Float[np.ndarray, " q"]]]
"""Direction -> object and average precision of each query."""


def run(config: Config) -> dict[str, Any]:
    """Fit heads and judge retrieval, split by split."""
    splits: tuple[Split, ...] = config.splits
    if is_tvl(config.data):
        if config.trained:
            raise UserError("--trained needs touches of the wand: leave it out for TVL")
        data = embed_captioned(config.data, config.encoders, config.seed, config.cache)
        splits = tuple(split for split in splits if split != "sentence")  # each object has one
    else:
        data = embed_set(config.data, config.encoders, config.seed, config.cache)
    without = replace(config.heads, text_weight=0.0)
    judged = {"raw pixels": _nearest_in_pixels, "chance": _chance}
    for name in config.encoders:
        judged[name] = partial(_with_heads, name=name, config=config.heads)
        judged[f"{name}, without touch-text"] = partial(_with_heads, name=name, config=without)
    once = _judges_that_train(config)
    rows, pools = [], {}
    work = list(product(splits, judged | once))
    for split, what in track(work, "retrieval", "row"):
        seeds = range(1 if what in once else config.seeds)
        folds = [data.fold(split, seed) for seed in seeds]
        judge_fold = (judged | once)[what]
        found = [judge_fold(data, fold, seed) for seed, fold in enumerate(folds)]
        rows.append({"split": split, "row": what, "seeds": len(folds), **_summary(found)})
        pools[split] = _pool(data, folds[0])
    return {"table": _table(rows, pools), "rows": rows, "pools": pools}


def _with_heads(data: EmbeddedSet, fold: Fold, seed: int, name: str, config: HeadsConfig) -> Found:
    """Judge an encoder with heads that are fitted on the training side."""
    touch = F.normalize(torch.from_numpy(data.touch[name]), dim=1)
    paired = PairedEmbeddings(
        touch=touch[fold.train],
        label=torch.from_numpy(data.label[fold.train]),
        image=torch.from_numpy(data.image[fold.train]),
        texts=torch.from_numpy(data.texts[fold.train_text]),
        describes=torch.from_numpy(data.describes[:, fold.train_text]),
    )
    heads = fit_heads(paired, config, seed)
    with torch.no_grad():
        image = heads.image(torch.from_numpy(data.image[fold.test])).mean(1)
        text = heads.text(torch.from_numpy(data.texts[fold.test_text]))
    unit = F.normalize(image, dim=1)
    return judge(
        data, fold, {"touch": touch[fold.test].numpy(), "image": unit.numpy(), "text": text.numpy()}
    )


def _judges_that_train(config: Config) -> dict[str, Callable[[EmbeddedSet, Fold, int], Found]]:
    """Return the rows whose backbones are trained; the touches are read only if there are any."""
    if not config.trained:
        return {}
    check_device(config.device)
    towers = load_towers("offline")
    touches, rows = read_touch_data(WandSet.open(config.data), towers), {}
    for backbone, weight in product(config.trained, (1.0, 0.0)):
        align = AlignConfig(backbone=backbone, epochs=config.epochs, text_weight=weight)
        without = "" if weight else ", without touch-text"
        rows[f"{backbone} trained{without}"] = partial(
            _trained, touches, towers, align, config.device
        )
    return rows


def _trained(
    touches: TouchData,
    towers: Towers,
    config: AlignConfig,
    device: str,
    data: EmbeddedSet,
    fold: Fold,
    seed: int,
) -> Found:
    """Judge an encoder whose backbone is trained on the training side as well."""
    encoder = train(
        touches, fold, data.sensor, towers, config, TrainerOptions(seed=seed, device=device)
    )
    return judge(data, fold, embed_fold(encoder, touches, fold))


def judge(data: EmbeddedSet, fold: Fold, embedded: dict[str, Float[np.ndarray, "_ d"]]) -> Found:
    """Judge all directions between modalities; queries without a right candidate are skipped.

    Args:
        embedded: unit vectors of one space: of the test touches, their images, the test sentences;
            two of them or all three.
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
        if not {first, second} <= embedded.keys():
            continue
        similarity = embedded[first] @ embedded[second].T
        if pair == "touch image":
            similarity = np.where(own, -np.inf, similarity)
        for one, other, s, r in (
            (first, second, similarity, relevant),
            (second, first, similarity.T, relevant.T),
        ):
            asked = r.any(1)
            found[f"{one} to {other}"] = (
                of_object[one][asked],
                average_precisions(s[asked], r[asked]),
            )
    return found


def _nearest_in_pixels(data: EmbeddedSet, fold: Fold, seed: int) -> Found:
    """Represent a touch by the image and sentences of the nearest training touch in raw pixels."""
    pixels, image, texts = (_unit(a) for a in (data.pixels, data.image.mean(1), data.texts))
    nearest = fold.train[(pixels[fold.test] @ pixels[fold.train].T).argmax(1)]
    own = data.describes[data.label[nearest]] & fold.train_text
    by_text = {"touch": _unit(own @ texts), "text": texts[fold.test_text]}
    by_image = {"touch": image[nearest], "image": image[fold.test]}
    return judge(data, fold, by_image) | judge(data, fold, by_text)


def _chance(data: EmbeddedSet, fold: Fold, seed: int) -> Found:
    n, m = len(fold.test), int(fold.test_text.sum())
    return judge(
        data, fold, {k: np.zeros((c, 1)) for k, c in dict(touch=n, image=n, text=m).items()}
    )


def _unit(x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def _summary(found: list[Found]) -> dict[str, Interval]:
    """Return mAP by direction over all seeds, without directions that have no queries."""
    summary = {}
    for direction in found[0]:
        objects, value = (
            np.concatenate(c) for c in zip(*(f[direction] for f in found), strict=True)
        )
        if len(value):
            summary[direction] = mean_over_objects(objects, value)
    return summary


def _pool(data: EmbeddedSet, fold: Fold) -> dict[str, int]:
    return {
        "train": len(fold.train),
        "test": len(fold.test),
        "sentences": int(fold.test_text.sum()),
        "objects": len(np.unique(data.label[fold.test])),
    }


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
        cells = [["", *PUBLISHED]]
        if split == "sample":
            for i, what in enumerate(("published", "published, without touch-text")):
                cells.append([what, *(f"{v[i]:.2f}" for v in PUBLISHED.values())])
        for row in (r for r in rows if r["split"] == split):
            cells.append([row["row"], *(cell(row[d]) if d in row else "" for d in PUBLISHED)])
        lines += [*aligned(cells), ""]
    return "\n".join(lines)
