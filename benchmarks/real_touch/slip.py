"""Slip told from windows of equal length on a Franka's two fingertips, whole objects held out.

The length of a recording and the crop of its camera tell the outcome. So windows have equal length, and
a slip is compared only with grasps without slip in the same crop.
"""

from dataclasses import field
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Real, UInt8

from benchmarks.options import BenchmarkOptions
from benchmarks.real_touch import property_probe as probe
from touchgoal.control.sensors.clip import read_frames
from touchgoal.control.tactile.image_guard import in_light_of
from touchgoal.control.tactile.markers.tracker import MarkerTracker, without_markers
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI, GELSIGHT_MINI_MARKERS, MarkerGrid
from touchgoal.encoders.pretrained import AnyTouchEncoder, load_encoder
from touchgoal.episodes.importers.labelled_videos import check_there, read_table
from touchgoal.runtime.option_types import checked_dataclass
from touchgoal.runtime.progress import track


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark real-slip."""

    data: Path = field(kw_only=True)
    """Folder with grasps.csv (object, slip, frames_kept, finger_0, finger_2) and the videos it names."""
    encoders: tuple[str, ...] = ("gelsight_mini_markers_mae", "gelsight_mini")
    """Touch encoders whose change over a window is read; those of plain gels with the dots painted over."""


WINDOWS = "same frames of all", "last second", "a second earlier"
LENGTH, EARLY, LEAD = 24, 49, 25  # frames: a window, end of the first one, lead of the third one
_LONGEST = 250  # frames that a grasp without slip keeps
_SETTLED = 10  # frame by which the camera's light has settled
_EVERY = 3  # frames from one embedding to the next
_WIDE = 38.0  # px between dots; the two crops have 31 to 33 and 43 to 48
_STRENGTH = 1.0  # of the ridge, fixed beforehand
_GRID: MarkerGrid = GELSIGHT_MINI_MARKERS.markers  # pyright: ignore[reportAssignmentType]
_FINGERS = "finger_0", "finger_2"


class Labels(NamedTuple):
    """Labels of n grasps; the crop of the camera is told by the spacing of the dots."""

    objects: probe.Objects
    slip: Bool[np.ndarray, " n"]
    crop: Int[np.ndarray, " n"]


def run(config: Config) -> dict[str, Any]:
    """Predict slip by every kind of feature in every window."""
    index = config.data / "grasps.csv"
    table = read_table(index, ("object", "slip", "frames_kept", *_FINGERS))
    clips = [[config.data / row[finger] for finger in _FINGERS] for row in table]
    check_there(sum(clips, []), index)
    encoders = {name: load_encoder(name).eval() for name in config.encoders}
    objects, slip = np.array([(row["object"], row["slip"]) for row in table]).T
    length = np.array([min(int(row["frames_kept"]), _LONGEST) for row in table])
    crop = np.array([int(_tracker(read_frames(c[0])[0][0])[1] > _WIDE) for c in clips])
    labels = Labels(objects, slip == "1", crop)
    ends = _window_ends(labels, length)
    found = [
        [read_finger(read_frames(path)[0][: own.max()], own, encoders) for path in clip]
        for clip, own in track(list(zip(clips, ends, strict=True)), "tracking", "grasp")
    ]
    rows = []
    for w, window in enumerate(WINDOWS):
        features = {n: np.array([[f[w][n] for f in g] for g in found]) for n in found[0][0][0]}
        features["control: frame of the end"] = np.repeat(1.0 * ends[:, w, None, None], 2, 1)
        for name, own in features.items():
            rows.append({"window": window, "features": name, **judge(own, labels)})
    values = {"length": -length, "crop": crop}
    leaks = {n: auc(np.stack([x, labels.slip, 0 * crop], 1)) for n, x in values.items()}
    result = {"grasps": len(slip), "slips": int(labels.slip.sum()), "leaks": leaks, "rows": rows}
    return {"table": _table(result), **result}


def _window_ends(labels: Labels, length: Int[np.ndarray, " n"]) -> Int[np.ndarray, "n windows"]:
    """Return where windows end: without slip, as late as recordings of a slip in the same crop."""
    (_, slip, crop), ends, rng = labels, length.copy(), np.random.default_rng(0)
    for row in np.flatnonzero(~slip):
        fits = length[slip & (crop == crop[row]) & (length <= length[row])]
        ends[row] = rng.choice(fits) if len(fits) else length[row]
    return np.stack([np.minimum(ends, EARLY), ends, ends - LEAD], 1)


def _tracker(frame: UInt8[np.ndarray, "h w 3"]) -> tuple[MarkerTracker, float]:
    """Return a tracker of the grid that a frame shows, and its dots' spacing, px."""
    tracker = MarkerTracker(frame, _GRID, GELSIGHT_MINI_MARKERS.pixel_pitch)
    steps = np.diff(tracker.rest.positions, axis=1)
    return tracker, float(np.median(np.linalg.norm(steps, axis=-1)))


def read_finger(
    frames: UInt8[np.ndarray, "n h w 3"],
    ends: Int[np.ndarray, " windows"],
    encoders: dict[str, AnyTouchEncoder],
) -> list[dict[str, np.ndarray]]:
    """Return the features of one finger in each window."""
    tracker, spacing = _tracker(frames[0])
    followed = [tracker.rest] + [tracker.update(frame) for frame in frames[1:]]
    radius = tracker.rest.largest_radius(_GRID)
    windows = []
    for rows in (np.arange(end - LENGTH, end) for end in ends):
        dots = np.stack([followed[i].positions for i in rows])
        own = {"markers": motion_features(dots / spacing)}
        for name, encoder in encoders.items():
            read, untouched = frames[rows[::_EVERY]], frames[_SETTLED]
            if encoder.preprocess.sensor == GELSIGHT_MINI.name:
                pairs = zip(read, dots[::_EVERY], strict=True)
                read = np.stack([without_markers(image, at, radius) for image, at in pairs])
                background = load(GELSIGHT_MINI.sensor_file).background
                untouched = np.rint(in_light_of(read[0], background)).astype(np.uint8)
            embedded = encoder.embed_frames(read, untouched)
            own[name], own[f"control: one frame, {name}"] = embedded.std(0), embedded[0]
        windows.append(own | {"control: brightness": frames[rows].mean((0, 1, 2))})
    return windows


def motion_features(dots: Float[np.ndarray, "t rows columns 2"]) -> Float[np.ndarray, " 8"]:
    """Return the log of an affine fit's figures over the window, and at most and usually by frame."""
    points = dots.reshape(len(dots), -1, 2).astype(float)
    steps = np.array([_affine(a, b)[:2] for a, b in pairwise(points)])
    return np.log(1e-3 + np.hstack([_affine(points[0], points[-1]), steps.max(0), steps.mean(0)]))


def _affine(one: Float[np.ndarray, "n 2"], other: Float[np.ndarray, "n 2"]) -> list[float]:
    """Return mean displacement, rms residual of the affine fit, and its rotation and expansion."""
    terms = np.column_stack([np.ones(len(one)), one - one.mean(0)])
    shift, x, y = fit = np.linalg.lstsq(terms, other - one, rcond=None)[0]
    left = np.sqrt(np.square(other - one - terms @ fit).sum(1).mean())
    return [float(np.linalg.norm(shift)), float(left), abs(x[1] - y[0]), abs(x[0] + y[1])]


def predict_slip(features: Float[np.ndarray, "n 2 d"], labels: Labels) -> Float[np.ndarray, " n"]:
    """Return scores of slip by a ridge on other objects, the mean over fingers.

    Features are standardised and labels centred within each crop, so the crop helps nothing.
    """
    (objects, slip, crop), inputs, scores = labels, features.copy(), np.zeros(len(features))
    for own in (crop == c for c in np.unique(crop)):
        inputs[own] = (inputs[own] - inputs[own].mean((0, 1))) / (inputs[own].std((0, 1)) + 1e-6)
    for test in probe.folds(objects):
        rate = np.array([slip[~test & (crop == c)].mean() for c in crop])
        known, new = (inputs[rows].reshape(-1, inputs.shape[2]) for rows in (~test, test))
        targets = np.repeat((slip - rate)[~test], 2)[:, None]
        scores[test] = probe.ridge_scores(known, targets, new, _STRENGTH).reshape(-1, 2).mean(1)
    return scores.round(9)  # a constant feature's scores are ties


def judge(features: Float[np.ndarray, "n 2 d"], labels: Labels) -> dict[str, list[float]]:
    """Return AUC and its interval by pairs of one crop, and by pairs of one object in one crop."""
    (objects, slip, crop), found, scores = labels, {}, predict_slip(features, labels)
    _, one = np.unique([objects, crop.astype(str)], axis=1, return_inverse=True)
    for name, strata in (("crop", crop), ("object", one)):
        both = np.array([len(set(slip[strata == s])) == 2 for s in strata])
        values = np.column_stack([scores, slip, strata])[both]
        found[name] = [auc(values), *probe.interval(values, objects[both], auc)]
    return found


def auc(values: Real[np.ndarray, "n 3"]) -> float:
    """Return AUC by pairs of one stratum; columns are score, slip and stratum, ties count half."""
    slips, others = values[values[:, 1] > 0], values[values[:, 1] == 0]
    above = np.sign(slips[:, None, 0] - others[:, 0])
    return float((1 + above[slips[:, None, 2] == others[:, 2]]).mean() / 2)


def _table(result: dict[str, Any]) -> str:
    width = max(len(row["features"]) for row in result["rows"]) + 2
    lines = [
        f"AUC of slip on objects held out [95 % over objects], windows of {LENGTH} frames",
        "{grasps} grasps, {slips} slips; leaks: shortness {length:.2f}, the camera's crop {crop:.2f}".format(
            **result, **result["leaks"]
        ),
    ]
    for window in WINDOWS:
        lines += ["", f"{window:<{width}}{'pairs of one crop':<19}pairs of one object"]
        for row in (row for row in result["rows"] if row["window"] == window):
            crop, own = ("{:.2f} [{:.2f}, {:.2f}]".format(*row[n]) for n in ("crop", "object"))
            lines.append(f"{row['features']:<{width}}{crop:<19}{own}")
    return "\n".join(lines)
