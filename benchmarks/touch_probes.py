"""What frozen features tell beside what is touched: force, place, shape, slip; on one sensor and on others.

Ten indenters are pressed with known forces into simulated units of each sensor. A ridge reads frozen
features: of the shipped encoder's network, or of the tokens of a ViT, pooled over the picture and over its parts. Its input is either
the sensor's own change of colour, or the shape that all sensors share: slopes and depth of the gel, read
from the picture by the unit's sensor file and drawn at one scale. Centred: each sensor's features less their mean over
presses that nobody needs to have labelled. Units of training are not tested on. Real presses of a ball, where there
are some, are read by the same probes.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32

from touchgoal.benchmarks.config import TouchProbesOptions
from touchgoal.benchmarks.touch_features import Change, PressFeatures, press_features
from touchgoal.control.sensors.fingertip_source import recorded_frames
from touchgoal.control.tactile.depth import DepthEstimator
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.encoders.pretrained import load_encoder
from touchgoal.encoders.probes.ridge import ridge_scores
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.tactile.indenters import FIELD, INDENTERS, IndenterPose, indent
from touchgoal.sim_envs.tactile.optics import render_untouched
from touchgoal.sim_envs.tactile.sensor_instance import sample_instance

FORCES = 0.5, 15.0
"""N, least and most; forces between are drawn evenly."""
SLIDES = 0.4e-3, 1.5e-3
"""m that an indenter slides between two frames; one that sticks moves with the gel, by up to _SHEAR."""
_SHEAR = 0.15e-3
_PLACES = 2.5e-3  # m from the middle
_UNITS, _TEST_UNITS = 6, 2
_SLOPE, _DEPTH = 2.5, 4e3  # of the network's input (1.0 is a firm contact) per slope, and per m
_RIDGE = 0.01
_CELL = 4  # px of the depth's cells
_BLUR = 0.3e-3  # m, before the deepest place is looked for
_BALLS = [i for i, name in enumerate(INDENTERS) if name.endswith("ball")]
# Which features, and whether each sensor's are centred.
_INPUTS = {
    "colours": ("own", False),
    "shape": ("shared", False),
    "shape, centred": ("shared", True),
}


@dataclass(frozen=True, eq=False)
class Presses:
    """Features and truth of n presses on one sensor.

    Attributes:
        own, shared: features of the sensor's own colours, and of the shape.
        own_moved, shared_moved: of what changed since the frame before.
        shape: which indenter.
        force: N.
        place: m.
        slid: whether it did.
        test: whether its unit is one to test on.
    """

    own: Float32[np.ndarray, "n d"]
    shared: Float32[np.ndarray, "n d"]
    own_moved: Float32[np.ndarray, "n d"]
    shared_moved: Float32[np.ndarray, "n d"]
    shape: np.ndarray
    force: Float[np.ndarray, " n"]
    place: Float[np.ndarray, "n 2"]
    slid: np.ndarray
    test: np.ndarray


@dataclass(frozen=True, eq=False)
class RealBalls:
    """Features of n real presses of a ball, see `Presses`."""

    own: Float32[np.ndarray, "n d"]
    shared: Float32[np.ndarray, "n d"]


def run(config: TouchProbesOptions) -> dict[str, Any]:
    """Press, embed, probe within and across sensors."""
    features = press_features(load_encoder(config.encoder).eval())
    balls = {
        name: _real_balls(folder, name, features)
        for name, folder in zip(config.sensors, config.real_balls, strict=False)
    }
    sets = {name: _presses(name, features, config) for name in config.sensors}
    rows = [
        {
            "from": source,
            "to": target,
            "input": kind,
            **_probe(sets[source], sets[target], kind, balls.get(target)),
        }
        for kind in _INPUTS
        for source in sets
        for target in sets
    ]
    return {"table": _table(rows, config), "rows": rows}


def _presses(name: str, features: PressFeatures, config: TouchProbesOptions) -> Presses:
    sensor, rng = find_sensor(name), np.random.default_rng([config.seed, len(name)])
    units = [sample_instance(sensor, rng) for _ in range(_UNITS)]
    depths = [DepthEstimator(unit.calibration, _CELL) for unit in units]
    names = list(INDENTERS)
    rows: list[list[Any]] = []
    for i in track(range(config.presses), name, "press"):
        u, shape = i % _UNITS, int(rng.integers(len(names)))
        unit, force, slid = units[u], float(rng.uniform(*FORCES)), bool(rng.random() < 0.5)
        x, y = rng.uniform(-_PLACES, _PLACES, 2)
        turn, way = rng.uniform(0, 2 * np.pi, 2)
        far = rng.uniform(*SLIDES) if slid else rng.uniform(0, _SHEAR)
        before = IndenterPose(x - far * np.cos(way), y - far * np.sin(way), turn)
        rest = render_untouched(unit, rng)
        frames = [
            indent(names[shape], pose, force * load, unit, rng)
            for pose, load in ((before, rng.uniform(0.85, 1.1)), (IndenterPose(x, y, turn), 1.0))
        ]
        changes = [(frame.astype(np.float32) - rest) / 16 for frame in frames]
        pitch = unit.pixel_pitch
        own = [_field(change, pitch, features.shape) for change in changes]
        reliefs = [_shape(frame, rest, pitch, depths[u]) for frame in frames]
        shared = [_field(relief, pitch, features.shape) for relief in reliefs]
        (now, moved), (felt, felt_moved) = features(*own), features(*shared)
        seen = [now, felt, moved, felt_moved]
        rows.append([*seen, shape, force, (x, y), slid, u >= _UNITS - _TEST_UNITS])
    return Presses(*(np.array(column) for column in zip(*rows, strict=True)))


def _real_balls(folder: Path, name: str, features: PressFeatures) -> RealBalls:
    """Real presses, by the sensor file of the model and not of the unit.

    They lie anywhere on the gel: what is seen of each is the field around its deepest place.
    """
    sensor = find_sensor(name)
    estimator, pitch = DepthEstimator(load(sensor.sensor_file), _CELL), sensor.pixel_pitch
    rest, *frames = recorded_frames(folder, sensor)
    own, shared = [], []
    for frame in track(frames, f"real balls, {name}", "press"):
        relief = _shape(frame, rest, pitch, estimator)
        depth = cv2.GaussianBlur(relief[..., 2], (0, 0), _BLUR / pitch)
        y, x = np.unravel_index(depth.argmax(), depth.shape)
        colours, shape = (
            _field(change, pitch, features.shape, (int(x), int(y)))
            for change in ((frame.astype(np.float32) - rest) / 16, relief)
        )
        own.append(features(np.zeros_like(colours), colours)[0])
        shared.append(features(np.zeros_like(shape), shape)[0])
    return RealBalls(np.stack(own), np.stack(shared))


def _field(
    change: Change,
    pixel_pitch: float,
    shape: tuple[int, int],
    around: tuple[int, int] | None = None,
) -> Change:
    """A sensor's picture around its middle or another place (px), at the scale that all share.

    FIELD goes from top to bottom; nothing is touched where the picture ends before.
    """
    (h, w, _), (rows, columns) = change.shape, shape
    scale = FIELD / rows / pixel_pitch  # px of the picture per px of the field
    x, y = around or ((w - 1) / 2, (h - 1) / 2)
    shift = [x - scale * (columns - 1) / 2, y - scale * (rows - 1) / 2]
    to_picture = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(change, to_picture, (columns, rows), flags=flags)


def _shape(
    frame: np.ndarray, rest: np.ndarray, pixel_pitch: float, estimator: DepthEstimator
) -> Change:
    """Slopes along x and y, and depth."""
    depth = estimator.estimate(frame, rest.astype(np.float32))
    gy, gx = np.gradient(depth, np.float32(pixel_pitch))
    return np.stack([_SLOPE * gx, _SLOPE * gy, _DEPTH * depth], -1).astype(np.float32)


def _probe(known: Presses, asked: Presses, kind: str, balls: RealBalls | None) -> dict[str, float]:
    name, centred = _INPUTS[kind]
    train, test = ~known.test, asked.test
    shapes = np.eye(len(INDENTERS))[known.shape[train]]
    targets = np.column_stack([known.force[train], 1e3 * known.place[train], 10 * shapes])
    inputs, others = _features(known, name, centred)[train], _features(asked, name, centred)[test]
    read = ridge_scores(inputs, targets, others, _RIDGE)
    moved, other_moved = (
        _features(presses, f"{name}_moved", centred)[rows]
        for presses, rows in ((known, train), (asked, test))
    )
    slid = (
        ridge_scores(moved, known.slid[train, None].astype(float), other_moved, _RIDGE)[:, 0] > 0.5
    )
    right = float((slid & asked.slid[test]).sum())
    off = np.linalg.norm(read[:, 1:3] - 1e3 * asked.place[test], axis=1)
    real = {}
    if balls is not None:
        seen = getattr(balls, name) - (_middle(asked, name) if centred else 0)
        said = ridge_scores(inputs, targets, seen, _RIDGE)[:, 3:].argmax(1)
        others = read[~np.isin(asked.shape[test], _BALLS), 3:].argmax(1)
        real["real_balls"] = float(np.isin(said, _BALLS).mean())
        real["others_called_balls"] = float(np.isin(others, _BALLS).mean())
    return {
        **real,
        "force_error": float(np.median(np.abs(read[:, 0] - asked.force[test]))),
        "place_error_mm": float(np.median(off)),
        "shape": float((read[:, 3:].argmax(1) == asked.shape[test]).mean()),
        "slip_f1": 2 * right / max(float(slid.sum() + asked.slid[test].sum()), 1),
    }


def _features(presses: Presses, name: str, centred: bool) -> Float32[np.ndarray, "n d"]:
    features = getattr(presses, name)
    return features - _middle(presses, name) if centred else features


def _middle(presses: Presses, name: str) -> Float32[np.ndarray, " d"]:
    """The mean of a sensor's features, of units that are not tested on."""
    return getattr(presses, name)[~presses.test].mean(0)


def _table(rows: list[dict[str, Any]], config: TouchProbesOptions) -> str:
    tested = config.presses // _UNITS * _TEST_UNITS
    lines = [
        f"{config.presses} presses of {len(INDENTERS)} indenters on each sensor, tested on {tested} of other units;",
        f"force of {FORCES[0]:g} to {FORCES[1]:g} N, median error; place, median error; slip against sticking",
        f"{'probe from':<24}{'read on':<24}{'input':<15}{'force':>8}{'place':>10}{'shape':>7}{'slip F1':>9}",
    ]
    lines += [
        f"{row['from']:<24}{row['to']:<24}{row['input']:<15}"
        f"{row['force_error']:>6.1f} N{row['place_error_mm']:>7.2f} mm{row['shape']:>7.2f}"
        f"{row['slip_f1']:>9.2f}"
        for row in rows
    ]
    real = [row for row in rows if "real_balls" in row]
    if real:
        lines += [
            "",
            "share called a ball: of real presses of a ball, and of simulated ones of the other indenters",
            f"{'probe from':<24}{'read on':<24}{'input':<15}{'real balls':>11}{'others':>9}",
        ]
    lines += [
        f"{row['from']:<24}{row['to']:<24}{row['input']:<15}"
        f"{row['real_balls']:>11.2f}{row['others_called_balls']:>9.2f}"
        for row in real
    ]
    return "\n".join(lines)
