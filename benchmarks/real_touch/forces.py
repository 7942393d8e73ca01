"""Contact and force on real grasps with a load cell, on objects outside the calibration."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from benchmarks.options import BenchmarkOptions
from benchmarks.published_touch.force_grasps import ForceGrasp, read_force_grasps
from benchmarks.real_touch.embedders import Embedder, find_embedder
from benchmarks.real_touch.image_force import calibrate_force, change_statistics, resized
from benchmarks.real_touch.property_probe import interval
from touchgoal.control.tactile.background import Background
from touchgoal.control.tactile.contact import ContactDetector
from touchgoal.control.tactile.sensor_models import GELSIGHT_WEDGE
from touchgoal.rewards.features.contact_reading import ContactReader
from touchgoal.rewards.metrics import spearman
from touchgoal.runtime.option_types import RARE, Corners, Count, Seed, checked_dataclass
from touchgoal.runtime.progress import track


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark real-force."""

    data: Path = field(kw_only=True)
    """Folder with grasps.csv, TRIAL.avi and TRIAL.csv, laid out as EstimateModulus'."""
    encoders: tuple[str, ...] = ("gelsight_mini", "pixels")
    """Touch encoders, named as for benchmark real-touch."""
    corners: Corners | None = None
    """Corners of the gel in the image, x and y in px (top left, top right, bottom left, bottom
    right), for a camera that sees it at an angle; default: the whole image."""
    every: Annotated[Count, RARE] = 1
    """Use every n-th grasp."""
    seed: Seed = 0
    """Random seed of untrained weights."""


RANGE = 25.0  # largest force that is judged, N
_PRESSED = 0.5  # N that count as contact
_FIRST = 5  # untouched frames at the start
_LASTING = 3  # frames that a fall of the cost must last
_FALLEN = 0.05  # share of the whole fall that counts as its start
_NEAR = 3  # frames between force and fall of the cost that count as close
_STEADY = 0.2  # N: a smaller range of the first frames' force means an open hand
_IMPOSSIBLE = 60.0  # N, a spike of the load cell: the hand cannot do that


def run(config: Config) -> dict[str, Any]:
    """Calibrate on all objects but one, in turn, and judge the one left out."""
    embedders = {name: find_embedder(name, config.seed) for name in config.encoders}
    grasps = read_force_grasps(config.data, config.corners)[:: config.every]
    result = judge_grasps(grasps, embedders)
    result["ranks"] = judge_depth(grasps) if config.corners else {}
    return {"table": force_table(result), **result}


def judge_depth(grasps: list[ForceGrasp]) -> dict[str, float]:
    """Return for each grasp the rank correlation of force from depth with the load cell, in contact.

    It is the force that a reward's force part would compare were the file measured; it needs no calibration on a load cell.
    """
    ranks, wedge = {}, replace(GELSIGHT_WEDGE, measured=True)  # read as if it were
    for grasp in track(grasps, "reading depth", "grasp"):
        frames = grasp.frames()
        readings = ContactReader(wedge, frames[:_FIRST], GELSIGHT_WEDGE.frame_rate).read(frames)
        force = grasp.force[: len(frames)]
        in_contact = readings["held"] & (np.abs(force) < _IMPOSSIBLE)
        ranks[grasp.trial] = spearman(readings["force"][in_contact], force[in_contact])
    return {trial: rank for trial, rank in ranks.items() if rank is not None}


def judge_grasps(grasps: list[ForceGrasp], embedders: dict[str, Embedder]) -> dict[str, Any]:
    """Return force errors on held-out objects, contact delays and each encoder's cost curves."""
    rows, forces, objects, contact = [], [], [], []
    embedded: dict[str, list[EmbeddedGrasp]] = {name: [] for name in embedders}
    for grasp in track(grasps, "reading", "grasp"):
        frames = grasp.frames()
        force = grasp.force[: len(frames)]
        # A steady load cell means an open hand, and shows its offset; else the hand is closing.
        open_hand = float(np.ptp(force[:_FIRST])) < _STEADY
        if open_hand:
            force = force - np.median(force[:_FIRST])
        untouched = np.median(frames[: _FIRST if open_hand else 1], 0).astype(np.uint8)
        background = resized(untouched)
        small = [resized(frame).astype(np.uint8) for frame in frames]
        rows.append(np.stack([change_statistics(frame, background) for frame in small]))
        forces.append(force)
        objects.append(np.full(len(force), grasp.object))
        detector = ContactDetector(Background(np.stack(small[:1])))
        touched = np.array([detector.update(frame) for frame in small])
        begins = int((force > _PRESSED).argmax()) if (force > _PRESSED).any() else None
        if open_hand and touched.any() and begins is not None:
            contact.append(int(touched.argmax()) - begins)
        firmest = int(np.where(force < _IMPOSSIBLE, force, 0).argmax())
        for name, embed in embedders.items():
            embeddings = embed(frames, untouched).astype(np.float64)
            start = begins if open_hand else None
            embedded[name].append(EmbeddedGrasp(grasp.object, embeddings, firmest, start))
    every, force, frame_objects = map(np.concatenate, (rows, forces, objects))
    judged = (force <= RANGE) & (force > -1)
    error, names = np.full(len(force), np.nan), np.unique(frame_objects)
    for name in names:
        known = judged & (frame_objects != name)
        reader = calibrate_force(every[known], force[known])
        own = frame_objects == name
        error[own] = np.abs(reader.predict(every[own]) - force[own])
    pressed = judged & (force > _PRESSED)
    if len(names) == len(grasps):  # an object grasped once has no other grasp to compare with
        embedded = {}
    return {
        "grasps": len(grasps),
        "objects": len(names),
        "median_error": _median(error[pressed]),
        "median_error_interval": interval(error[pressed], frame_objects[pressed], _median),
        "by_object": {str(n): _median(error[pressed & (frame_objects == n)]) for n in names},
        "contact_delay": contact,
        "cost": {name: judge_cost(embeddings) for name, embeddings in embedded.items()},
    }


def _median(values: np.ndarray) -> float:
    return float(np.median(values))


def force_table(result: dict[str, Any]) -> str:
    """Return the result as printed text."""
    low, high = result["median_error_interval"]
    delay = result["contact_delay"]
    objects = ", ".join(f"{name} {error:.1f}" for name, error in result["by_object"].items())
    lines = [
        f"{result['grasps']} grasps of {result['objects']} objects; each is read with the others' calibration:",
        f"force of {_PRESSED:g} to {RANGE:g} N off by {result['median_error']:.2f} N (median; 95 % over "
        f"objects {low:.2f}-{high:.2f}), {100 * result['median_error'] / RANGE:.0f} % of the range",
        f"by object, N: {objects}",
    ]
    if delay:
        lines.append(
            f"contact is detected {min(delay)} to {max(delay)} frames (median {np.median(delay):g}) after "
            f"{_PRESSED:g} N on the load cell, in {len(delay)} grasps that start open"
        )
    if result["ranks"]:
        ranks = list(result["ranks"].values())
        lines.append(
            "force from the depth of the gel ranks the frames of a grasp as the load cell does: Spearman "
            f"{np.median(ranks):.2f} (median; {min(ranks):.2f} to {max(ranks):.2f})"
        )
    lines += ["\n" + cost_table(cost, name) for name, cost in result["cost"].items()]
    return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class EmbeddedGrasp:
    """One grasp with one encoder's embeddings."""

    object: str
    embeddings: Float[np.ndarray, "n d"]
    firmest: int  # frame of the largest force
    begins: int | None  # first with 0.5 N on the load cell; None if the hand was not open before

    @property
    def goal(self) -> Float[np.ndarray, " d"]:
        """Embedding at the largest force."""
        return self.embeddings[self.firmest]


def cost(
    embeddings: Float[np.ndarray, "*n d"], goal: Float[np.ndarray, " d"]
) -> Float[np.ndarray, "*n"]:
    """Return the cost to a goal: 1 untouched, 0 at the goal."""
    return 1 - embeddings @ goal / max(float(goal @ goal), 1e-12)


def judge_cost(grasps: list[EmbeddedGrasp]) -> dict[str, Any]:
    """Judge costs to another grasp of the same object and to other objects' grasps."""
    delays = [
        delay
        for grasp in grasps
        for other in grasps
        if other.object == grasp.object and other is not grasp and grasp.begins is not None
        if (delay := _delay(grasp, other.goal)) is not None
    ]
    firm = np.stack([grasp.goal for grasp in grasps])
    objects = np.array([grasp.object for grasp in grasps])
    costs = np.stack([cost(firm, goal) for goal in firm], 1)
    pairs = _aucs(costs, objects)
    by_goal = {name: float(np.mean(list(row.values()))) for name, row in pairs.items()}
    values, names = np.array(list(by_goal.values())), np.array(list(by_goal))
    return {
        "delays": delays,
        "near": float(np.mean(np.abs(delays) <= _NEAR)) if delays else float("nan"),
        "auc": float(values.mean()),
        "auc_interval": interval(values, names),
        "auc_of_pairs": pairs,
    }


def cost_table(result: dict[str, Any], encoder: str) -> str:
    """Return the result as printed text."""
    names = list(result["auc_of_pairs"])
    low, high = result["auc_interval"]
    delays = result["delays"]
    lines = [f"tactile cost by {encoder}, to the firmest frame of another grasp:"]
    if delays:
        lines.append(
            f"falls {min(delays)} to {max(delays)} frames (median {np.median(delays):g}) after 0.5 N on the "
            f"load cell, within {_NEAR} frames in {100 * result['near']:.0f} % of {len(delays)} pairs of grasps"
        )
    lines += [
        f"separates other objects: area under ROC {result['auc']:.2f} ({low:.2f}-{high:.2f}); by goal (row) and object:",
        " " * 27 + "".join(f"{name[:11]:>13}" for name in names),
    ]
    for name in names:
        row = result["auc_of_pairs"][name]
        cells = "".join(f"{row[n]:>13.2f}" if n in row else f"{'-':>13}" for n in names)
        lines.append(f"{name[:26]:<27}{cells}")
    return "\n".join(lines)


def _delay(grasp: EmbeddedGrasp, goal: np.ndarray) -> int | None:
    """Return frames from 0.5 N to a lasting fall of the cost; None if it never falls."""
    assert grasp.begins is not None
    costs = cost(grasp.embeddings, goal)
    start = float(np.median(costs[: min(_FIRST, max(grasp.begins, 1))]))
    down = costs < start - _FALLEN * (start - costs.min())
    lasting = np.convolve(down, np.ones(_LASTING), "valid") == _LASTING
    return int(lasting.argmax()) - grasp.begins if lasting.any() else None


def _aucs(costs: np.ndarray, objects: np.ndarray) -> dict[str, dict[str, float]]:
    """Return, for each pair of objects, how often the other object's grasp has the higher cost."""
    table: dict[str, dict[str, float]] = {}
    for goal in np.unique(objects):
        own = costs[np.ix_(objects == goal, objects == goal)]
        own = own[~np.eye(len(own), dtype=bool)]
        table[str(goal)] = {
            str(other): float(
                (own[:, None] < costs[np.ix_(objects == other, objects == goal)].ravel()).mean()
            )
            for other in np.unique(objects)
            if other != goal and len(own)
        }
    return {name: row for name, row in table.items() if row}
