"""Which object is it? MMWand's Table II on wand touches: image, touch and both, on frozen embeddings.

A linear probe and the nearest neighbour, on frozen embeddings and on raw pixels.
"""

from collections.abc import Callable
from dataclasses import field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from benchmarks.options import BenchmarkOptions
from benchmarks.papers.mmwand.embedded_set import EmbeddedSet, embed_set
from benchmarks.papers.mmwand.fine_tuned import Modality, Network, fine_tune, read_images
from benchmarks.papers.mmwand.intervals import Interval, cell, mean_over_objects
from benchmarks.papers.mmwand.splits import Fold
from benchmarks.papers.mmwand.trained import Trainable, embed_touches, read_touch_data, train
from touchgoal.encoders.alignment.config import AlignConfig
from touchgoal.encoders.alignment.wand_set import WandSet
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.encoders.training.trainer import check_device
from touchgoal.runtime.option_types import Count, Seed, checked_dataclass

PUBLISHED = {
    "VGG": (94.94, 79.48, 96.66),
    "ResNet": (96.28, 79.48, 97.70),
    "ViT": (95.51, 76.90, 97.99),
}
"""MMWand's Table II, %: fine-tuned on image, touch, both."""
PUBLISHED_PROBE = 3.24, 46.94, 47.22  # its linear probe on the aligned embeddings
_DECAYS = (1e-4, 1e-3, 1e-2, 1e-1)
_PIXELS = 300  # principal components of raw pixels that the probe sees


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark classification."""

    data: Path = field(kw_only=True)
    """Touches recorded by `collect-touches --body wand`."""
    encoders: tuple[str, ...] = ("gelsight_mini", "random:gelsight_mini")
    """Touch encoders: see benchmark real-touch."""
    splits: tuple[Literal["sample", "press"], ...] = ("sample", "press")
    """Units held out; whole objects cannot be, because an unseen object has no name to find."""
    seeds: Count = 3
    """Splits of each kind."""
    trained: tuple[Trainable, ...] = ()
    """Touch backbones to align with images and words on each split's touches before the probe, as the
    paper does; slow."""
    trained_epochs: Count = 20
    """Passes of this alignment over the touches."""
    fine_tuned: tuple[Network, ...] = ()
    """Networks to fine-tune as well, on each split and modality; slow."""
    modalities: tuple[Modality, ...] = ("image", "touch", "both")
    """Inputs of the fine-tuned networks."""
    epochs: Count = 12
    """Passes of the fine-tuning over the touches."""
    image_rows: Count = 112
    """Rows of their images, px."""
    device: str = "cpu"
    """Device of all trainings, as torch names it: cpu, cuda."""
    cache: Path = Path("runs/mmwand-embeddings")
    """Folder that keeps the embeddings."""
    seed: Seed = 0
    """Random seed."""


def run(config: Config) -> dict[str, Any]:
    """Fit probes and judge them."""
    data = embed_set(config.data, config.encoders, config.seed, config.cache)
    image = data.image.mean(1)
    inputs = {"images": image, "raw pixels": _principal(data.pixels, config.seed)}
    for name in config.encoders:
        inputs[name] = data.touch[name]
        inputs[f"images + {name}"] = np.hstack([_standard(image), _standard(data.touch[name])])
    rows = []
    for split in config.splits:
        folds = [data.fold(split, seed) for seed in range(config.seeds)]
        rows += [
            {"split": split, "input": name, **_judge(data.label, embedding, folds)}
            for name, embedding in inputs.items()
        ]
    rows += _trained(config, data) + _fine_tuned(config, data)
    return {"table": _table(rows, len(data.names)), "rows": rows}


def _trained(config: Config, data: EmbeddedSet) -> list[dict[str, Any]]:
    if not config.trained:
        return []
    options = TrainerOptions(seed=config.seed, device=config.device)
    check_device(config.device)
    towers, rows = load_towers("offline"), []
    touches = read_touch_data(WandSet.open(config.data), towers)
    for split in config.splits:
        fold = data.fold(split, config.seed)
        for backbone in config.trained:
            align = AlignConfig(backbone=backbone, epochs=config.trained_epochs)
            encoder = train(touches, fold, data.sensor, towers, align, options)
            embedding = embed_touches(encoder, touches)
            found = _judge(data.label, embedding, [fold])
            rows.append({"split": split, "input": f"{backbone} trained", **found})
    return rows


def _fine_tuned(config: Config, data: EmbeddedSet) -> list[dict[str, Any]]:
    if not config.fine_tuned:
        return []
    check_device(config.device)
    images, rows = read_images(WandSet.open(config.data), config.image_rows), []
    for split in config.splits:
        fold = data.fold(split, config.seed)
        for network in config.fine_tuned:
            for modality in config.modalities:
                inputs = list(images.values()) if modality == "both" else [images[modality]]
                rest = data.label, fold, config.epochs, config.seed, config.device
                right = fine_tune(network, inputs, *rest)
                found = mean_over_objects(data.label[fold.test], right)
                what = f"{network} fine-tuned, {modality}"
                rows.append({"split": split, "input": what, "fine_tuned": found})
    return rows


def _judge(
    label: Int[np.ndarray, " n"], embedding: Float[np.ndarray, "n d"], folds: list[Fold]
) -> dict[str, Interval]:
    hits: dict[str, list[np.ndarray]] = {"probe": [], "nearest": []}
    objects = []
    x, y = torch.from_numpy(embedding).float(), torch.from_numpy(label)
    for fold in folds:
        train, test = ((x[rows], y[rows]) for rows in (fold.train, fold.test))
        hits["probe"].append((probe(*train)(test[0]).argmax(1) == test[1]).numpy().astype(float))
        unit = F.normalize(train[0], dim=1), F.normalize(test[0], dim=1)
        hits["nearest"].append(
            (train[1][(unit[1] @ unit[0].T).argmax(1)] == test[1]).numpy().astype(float)
        )
        objects.append(label[fold.test])
    return {
        what: mean_over_objects(np.concatenate(objects), np.concatenate(h))
        for what, h in hits.items()
    }


Predict = Callable[[Float[Tensor, "m d"]], Float[Tensor, "m c"]]


def probe(x: Float[Tensor, "n d"], y: Int[Tensor, " n"]) -> Predict:
    """Fit a logistic regression on standardised inputs; its decay is chosen on a fifth of the rows."""
    mean, scale = x.mean(0), x.std(0) + 1e-6
    x = (x - mean) / scale
    order = torch.randperm(len(x), generator=torch.Generator().manual_seed(0))
    out, kept = order[: len(x) // 5], order[len(x) // 5 :]
    right = [
        (_logistic(x[kept], y[kept], d)(x[out]).argmax(1) == y[out]).float().mean() for d in _DECAYS
    ]
    predict = _logistic(x, y, _DECAYS[int(torch.stack(right).argmax())])
    return lambda new: predict((new - mean) / scale)


def _logistic(x: Float[Tensor, "n d"], y: Int[Tensor, " n"], decay: float) -> Predict:
    classes, d = int(y.max()) + 1, x.shape[1]
    weight = torch.zeros(d, classes, requires_grad=True)
    bias = torch.zeros(classes, requires_grad=True)
    optimizer = torch.optim.LBFGS([weight, bias], max_iter=60, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        value = F.cross_entropy(x @ weight + bias, y) + decay / 2 * weight.square().sum()
        value.backward()
        return value

    optimizer.step(loss)
    weight, bias = weight.detach(), bias.detach()
    return lambda new: new @ weight + bias


def _standard(x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    return (x - x.mean(0)) / (x.std(0) + 1e-6)


def _principal(pixels: Float[np.ndarray, "n p"], seed: int) -> Float[np.ndarray, "n d"]:
    """Project pixels on their first principal components."""
    centred = torch.from_numpy(pixels - pixels.mean(0))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        _, _, components = torch.pca_lowrank(centred, min(_PIXELS, *centred.shape), center=False)
    return (centred @ components).numpy()


def _table(rows: list[dict[str, Any]], kinds: int) -> str:
    lines = [f"right one of {kinds} objects, % [95 % over objects]; chance {100 / kinds:.1f}", ""]
    lines.append(
        f"{'split':<8}{'input':<42}{'linear probe':>20}{'nearest neighbour':>22}{'fine-tuned':>20}"
    )
    for row in rows:
        cells = [
            cell(row[what]) if what in row else "" for what in ("probe", "nearest", "fine_tuned")
        ]
        lines.append(
            f"{row['split']:<8}{row['input']:<42}{cells[0]:>20}{cells[1]:>22}{cells[2]:>20}"
        )
    lines += ["", "published (MMWand, Table II, split by sample): image / touch / both"]
    lines += [f"  {name} fine-tuned: {' / '.join(map(str, v))}" for name, v in PUBLISHED.items()]
    lines.append(
        f"  linear probe on the aligned embeddings: {' / '.join(map(str, PUBLISHED_PROBE))}"
    )
    return "\n".join(lines)
