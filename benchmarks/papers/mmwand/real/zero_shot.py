"""Materials of real objects by sentences, never trained on: MMWand's Table III, on ObjectFolder Real.

With --other: the same table on touches of the wand, see `other_set`. On episodes in which objects are
grasped: the objects in place of materials, see `grasped_objects`.

A touch gets the material whose sentences are nearest on average. The gel's untouched image is
the median of all touches, because none is published.
"""

from dataclasses import field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.bootstrap import mean_interval
from benchmarks.options import BenchmarkOptions
from benchmarks.papers.mmwand.grasped_objects import run_grasped_objects
from benchmarks.papers.mmwand.other_set import run_other_set
from benchmarks.published_touch.objectfolder_real import read_objectfolder_real, read_touches
from touchgoal.encoders.alignment.config import HeadsConfig
from touchgoal.encoders.pretrained import load_encoder
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.episodes.format import set_files
from touchgoal.rewards.report.tables import aligned
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Count, Seed, checked_dataclass

SENTENCES = {
    "ceramic": ("hard, smooth glazed ceramic", "a smooth and hard object like porcelain"),
    "glass": ("hard and very smooth glass", "a perfectly smooth, slick and hard object"),
    "iron": ("hard, rough cast iron", "a hard object with a coarse, grainy surface"),
    "plastic": ("smooth, firm plastic", "a slightly flexible object with a fine molded texture"),
    "polycarbonate": ("hard, smooth clear plastic", "a rigid and slick object of molded plastic"),
    "steel": ("hard, smooth polished steel", "a hard object with a sleek metal surface"),
    "wood": ("hard wood with a fine grain", "a firm object with shallow lines along the grain"),
}
"""Sentences about the usual feel of each material; none was chosen by its score."""
_BOOTSTRAPS = 1000


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark zero-shot."""

    data: Path = field(kw_only=True)
    """Folder of ObjectFolder Real, with objects.csv and touch/; episodes of `collect-demos`; or touches of
    the wand recorded with another sensor than those of --other."""
    other: Path | None = None
    """Touches of the wand with another sensor: heads trained on either set are judged on --data."""
    encoders: tuple[str, ...] = ("gelsight_mini",)
    """Touch encoders: names or folders. On ObjectFolder Real they need words of their own; on touches
    of the wand heads are trained."""
    seeds: Count = 3
    """Divisions of the wand's objects into seen and unseen ones."""
    heads: HeadsConfig = HeadsConfig()
    """Training of the heads on touches of the wand."""
    cache: Path = Path("runs/mmwand-embeddings")
    """Folder that keeps the embeddings of the wand's touches."""
    seed: Seed = 0
    """Random seed of the frames of grasps."""


def run(config: Config) -> dict[str, Any]:
    """Name the material of every labelled object."""
    if config.other is not None:
        rest = config.heads, config.seeds, config.cache
        return run_other_set(config.data, config.other, config.encoders, *rest)
    if (config.data / set_files.INFO).exists():
        return run_grasped_objects(config.data, config.encoders, config.seed)
    objects = read_objectfolder_real(config.data)
    touches, untouched = read_touches(objects)
    labelled = [i for i, item in enumerate(objects) if item.material is not None]
    materials = sorted({str(objects[i].material) for i in labelled})
    if unknown := [name for name in materials if name not in SENTENCES]:
        raise UserError(f"no sentence for {unknown[0]}; materials: {', '.join(SENTENCES)}")
    truth = np.array([materials.index(str(objects[i].material)) for i in labelled])
    sentences = [sentence for name in materials for sentence in SENTENCES[name]]
    rows = []
    for name in config.encoders:
        encoder = load_encoder(name).eval()
        if encoder.towers is None:
            raise UserError(f"{name} has no words: choose an encoder that `align` or `words` made")
        towers = load_towers(encoder.towers)
        touch = encoder.embed_frames(touches[labelled], untouched)
        text = encoder.embed_text_goal(sentences, towers)
        scores = (touch @ text.T).reshape(len(truth), len(materials), -1).mean(2)
        rows.append({"encoder": name, **_judge(scores, truth)})
    frequent = float(np.bincount(truth).max() / len(truth))
    return {"table": _table(rows, frequent, len(truth), materials), "rows": rows}


def _judge(scores: Float[np.ndarray, "n c"], truth: np.ndarray) -> dict[str, Any]:
    hit = scores.argmax(1) == truth
    recall = [hit[truth == k].mean() for k in np.unique(truth)]
    return {
        "accuracy": float(hit.mean()),
        "interval": list(mean_interval(hit.astype(float), _BOOTSTRAPS)),
        "balanced": float(np.mean(recall)),
        "answers": np.bincount(scores.argmax(1), minlength=scores.shape[1]).tolist(),
    }


def _table(rows: list[dict[str, Any]], frequent: float, objects: int, materials: list[str]) -> str:
    title = f"material of {objects} real objects by sentences [95 % over objects]"
    lines = [["", "right", "balanced", "answered"]]
    for row in rows:
        right = "{:.2f} [{:.2f}, {:.2f}]".format(row["accuracy"], *row["interval"])
        answers = " ".join(map(str, row["answers"]))
        lines.append([row["encoder"], right, f"{row['balanced']:.2f}", answers])
    lines.append(["the most frequent material", f"{frequent:.2f}", f"{1 / len(materials):.2f}", ""])
    return "\n".join([f"{title}: {', '.join(materials)}", *aligned(lines)])
