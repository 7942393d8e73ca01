"""Contact and force on real grasps with a load cell, on objects outside the calibration."""

from dataclasses import dataclass, field, replace
from itertools import permutations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.options import BenchmarkOptions
from benchmarks.published_touch.force_grasps import ForceGrasp, read_force_grasps
from benchmarks.real_touch.embedders import Embedder, find_embedder
from benchmarks.real_touch.image_force import (
    calibrate_force,
    change_statistics,
    contact_shape,
    resized,
)
from benchmarks.real_touch.property_probe import interval
from touchgoal.control.tactile.background import Background
from touchgoal.control.tactile.contact import ContactDetector
from touchgoal.control.tactile.depth import DepthEstimator
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import GELSIGHT_WEDGE
from touchgoal.encoders.pretrained import DEFAULT_ENCODER
from touchgoal.rewards.distance.normalizer import NORMALIZER, DistanceNormalizer
from touchgoal.rewards.distance.parts import object_distances, part_costs
from touchgoal.rewards.features.contact_reading import ContactReader
from touchgoal.rewards.features.embedded import Features, take_rows
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
GOALS = (3.0, 8.0, 15.0)  # N
_NEAR_GOAL = 1.0  # N between a goal and the frame that stands for it
_CELL = 8  # px, finest cells of the depth map, as in `ContactReader`
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
    result = judge_grasps([read_grasp(g, embedders) for g in track(grasps, "reading", "grasp")])
    return {"table": force_table(result), **result}


@dataclass(eq=False)
class ReadGrasp:
    """One grasp as it is read, frame by frame."""

    object: str
    force: Float[np.ndarray, " n"]  # load cell, N
    statistics: Float[np.ndarray, "n k"]  # of image and contact, see `ImageForce`
    nominal: Float[np.ndarray, " n"]  # force by the sensor file alone, N; zeros without corners
    begins: int | None  # first with 0.5 N on the load cell; None if the hand was not open before
    touched: int | None  # first in contact by the image
    embeddings: dict[str, Float[np.ndarray, "n d"]]  # by encoder
    read: Float[np.ndarray, " n"] = field(default_factory=lambda: np.zeros(0))
    """Force by a calibration on other objects, N."""

    @property
    def judged(self) -> Bool[np.ndarray, " n"]:
        """Frames whose force is judged."""
        return (self.force > _PRESSED) & (self.force <= RANGE)

    @property
    def firmest(self) -> int:
        """Frame of the largest force."""
        return int(np.where(self.force < _IMPOSSIBLE, self.force, 0).argmax())


def read_grasp(grasp: ForceGrasp, embedders: dict[str, Embedder]) -> ReadGrasp:
    """Read a grasp's images: statistics, contact, embeddings, and with corners the gel's depth.

    The statistics are those of the raw image: what lies beside the gel's corners moves, too.
    """
    frames, raw = grasp.frames(), replace(grasp, corners=None).frames()
    force = grasp.force[: len(frames)]
    # A steady load cell means an open hand, and shows its offset; else the hand is closing.
    open_hand = float(np.ptp(force[:_FIRST])) < _STEADY
    if open_hand:
        force = force - np.median(force[:_FIRST])
    first = _FIRST if open_hand else 1
    untouched, background = (np.median(f[:first], 0).astype(np.uint8) for f in (frames, raw))
    small = [resized(frame).astype(np.uint8) for frame in raw]
    statistics = np.stack([change_statistics(s, resized(background)) for s in small])
    nominal = np.zeros(len(frames))
    if grasp.corners is not None:
        estimator = DepthEstimator(load(GELSIGHT_WEDGE.sensor_file), _CELL)
        depths = [estimator.estimate(frame, untouched.astype(np.float32)) for frame in frames]
        shapes = [contact_shape(depth, GELSIGHT_WEDGE.pixel_pitch) for depth in depths]
        statistics = np.concatenate([statistics, shapes], 1)
        wedge = replace(GELSIGHT_WEDGE, measured=True)  # read as if its computed file were measured
        reader = ContactReader(wedge, frames[:_FIRST], wedge.frame_rate)
        nominal = reader.read(frames)["force"].astype(np.float64)
    detector = ContactDetector(Background(np.stack([resized(frames[0]).astype(np.uint8)])))
    seen = [detector.update(resized(frame).astype(np.uint8)) for frame in frames]
    pressed, touched = force > _PRESSED, np.array(seen)
    begins = int(pressed.argmax()) if open_hand and pressed.any() else None
    embeddings = {k: embed(frames, untouched).astype(np.float32) for k, embed in embedders.items()}
    at = int(touched.argmax()) if touched.any() else None
    return ReadGrasp(grasp.object, force, statistics, nominal, begins, at, embeddings)


def judge_grasps(grasps: list[ReadGrasp]) -> dict[str, Any]:
    """Return force errors on held-out objects, contact delays and each encoder's cost curves."""
    names = sorted({grasp.object for grasp in grasps})
    for name in names:
        others = [g for g in grasps if g.object != name]
        rows, force = (
            np.concatenate([getattr(g, k) for g in others]) for k in ("statistics", "force")
        )
        known = (force <= RANGE) & (force > -1)
        reader = calibrate_force(rows[known], force[known])
        for grasp in grasps:
            if grasp.object == name:
                grasp.read = reader.predict(grasp.statistics)
    by_object = {
        name: np.concatenate([(g.read - g.force)[g.judged] for g in grasps if g.object == name])
        for name in names
    }
    errors = np.concatenate(list(by_object.values()))
    whose = np.repeat(names, [len(e) for e in by_object.values()])
    compared = len(names) < len(grasps)  # an object grasped once has no other grasp to compare with
    depth = [spearman(g.nominal[g.judged], g.force[g.judged]) for g in grasps if g.nominal.any()]
    return {
        "grasps": len(grasps),
        "objects": len(names),
        "median_error": _median(np.abs(errors)),
        "median_error_interval": interval(np.abs(errors), whose, _median),
        "by_object": {name: _median(np.abs(error)) for name, error in by_object.items()},
        "bias": {name: _median(error) for name, error in by_object.items()},
        "contact_delay": [
            g.touched - g.begins for g in grasps if g.touched is not None and g.begins is not None
        ],
        "ranks": [rank for rank in depth if rank is not None],
        "followed": {n: follow_goals(grasps, n) for n in grasps[0].embeddings} if compared else {},
        "cost": {n: judge_cost(grasps, n) for n in grasps[0].embeddings} if compared else {},
    }


def follow_goals(grasps: list[ReadGrasp], encoder: str) -> dict[str, dict[str, float]]:
    """Return by goal (N) the correlation of each cost with the force's error, over pressed frames.

    A touch is a goal from another grasp of the same object; its cost has the shipped units.
    """
    units = DistanceNormalizer.load(DEFAULT_ENCODER / NORMALIZER).unit
    followed = {}
    for goal in GOALS:
        costs, errors = [], []
        for mine, other in permutations(grasps, 2):
            at = int(np.abs(other.force - goal).argmin())
            if mine.object != other.object or abs(other.force[at] - goal) > _NEAR_GOAL:
                continue
            own, end = (_features(g, encoder) for g in (mine, other))
            end = take_rows(end, slice(at, at + 1))
            parts = part_costs(own, end, units)
            row = {
                "embedding": object_distances(own["touch"], end["touch"])[:, 0],
                "touch": np.sqrt(np.mean([np.square(cost) for cost in parts.values()], 0)),
                "force": np.abs(mine.read - goal),
                "nominal force": np.abs(mine.nominal - goal),
            }
            costs.append({name: cost[mine.judged] for name, cost in row.items()})
            errors.append(np.abs(mine.force - goal)[mine.judged])
        if not costs:
            continue
        error = np.concatenate(errors)
        followed[f"{goal:g}"] = {
            name: float(np.corrcoef(np.concatenate([c[name] for c in costs]), error)[0, 1])
            for name in costs[0]
            if np.ptp(np.concatenate([c[name] for c in costs]))
        }
    return followed


def _features(grasp: ReadGrasp, encoder: str) -> Features:
    held = (grasp.force > _PRESSED)[:, None]
    force = grasp.read.astype(np.float32)[:, None]
    return {"touch": grasp.embeddings[encoder][:, None], "held": held, "force": force}


def _median(values: np.ndarray) -> float:
    return float(np.median(values))


def force_table(result: dict[str, Any]) -> str:
    """Return the result as printed text."""
    low, high = result["median_error_interval"]
    delay, ranks = result["contact_delay"], result["ranks"]
    lines = [
        f"{result['grasps']} grasps of {result['objects']} objects; each is read with the others' calibration:",
        f"force of {_PRESSED:g} to {RANGE:g} N off by {result['median_error']:.2f} N (median; 95 % over "
        f"objects {low:.2f}-{high:.2f}), {100 * result['median_error'] / RANGE:.0f} % of the range",
        f"{'object':<27}{'median error, N':>16}{'bias, N':>9}",
    ]
    for name, error in result["by_object"].items():
        lines.append(f"{name:<27}{error:>16.2f}{result['bias'][name]:>+9.2f}")
    if delay:
        lines.append(
            f"contact is detected {min(delay)} to {max(delay)} frames (median {np.median(delay):g}) after "
            f"{_PRESSED:g} N on the load cell, in {len(delay)} grasps that start open"
        )
    if ranks:
        lines.append(
            "force by the sensor file alone ranks the frames of a grasp as the load cell does: Spearman "
            f"{np.median(ranks):.2f} (median; {min(ranks):.2f} to {max(ranks):.2f})"
        )
    for name, rows in result["followed"].items():
        costs = list(next(iter(rows.values()), ()))
        lines.append(f"\ncorrelation of the cost with the force's error, touch by {name}:")
        lines.append(f"{'goal':<6}" + "".join(f"{c:>15}" for c in costs))
        lines += [
            f"{goal + ' N':<6}" + "".join(f"{row[c]:>15.2f}" for c in costs)
            for goal, row in rows.items()
        ]
    if result["followed"]:
        lines.append(
            "  embedding: of another grasp's frame of that force; touch: the same frame's parts, force "
            "among them; force: newtons, read with the others' calibration, or nominal (sensor file)"
        )
    lines += ["\n" + cost_table(cost, name) for name, cost in result["cost"].items()]
    return "\n".join(lines)


def cost(
    embeddings: Float[np.ndarray, "*n d"], goal: Float[np.ndarray, " d"]
) -> Float[np.ndarray, "*n"]:
    """Return the cost to a goal: 1 untouched, 0 at the goal."""
    return 1 - embeddings @ goal / max(float(goal @ goal), 1e-12)


def judge_cost(grasps: list[ReadGrasp], encoder: str) -> dict[str, Any]:
    """Judge an encoder's costs to another grasp of the same object and to other objects' grasps."""
    firm = np.stack([g.embeddings[encoder][g.firmest] for g in grasps]).astype(np.float64)
    delays = [
        delay
        for grasp in grasps
        for other, goal in zip(grasps, firm, strict=True)
        if other.object == grasp.object and other is not grasp
        if (delay := _delay(grasp, encoder, goal)) is not None
    ]
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


def _delay(grasp: ReadGrasp, encoder: str, goal: np.ndarray) -> int | None:
    """Return frames from 0.5 N to a lasting fall of the cost; None if it never falls."""
    if grasp.begins is None:
        return None
    costs = cost(grasp.embeddings[encoder].astype(np.float64), goal)
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
