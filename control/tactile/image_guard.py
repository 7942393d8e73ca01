"""Check that fingertip images are the sensor's: whole, in RGB order, the right way round.

The untouched image is compared with the sensor file's under other channel orders, mirrors, scales
and shifts, ignoring each channel's gain. A hypothesis that fits clearly better is the fault. A step
across half a row is the seam of a torn image. Presses decide between hypotheses that fit equally:
a Mini's untouched image is nearly the same mirrored left to right, but then its sensor file
explains no press. Printed dots and dust do not count.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, product

import cv2
import numpy as np
from jaxtyping import Float32

from touchgoal.control.arrays import Counts, Image, Map
from touchgoal.control.tactile.background import local_change
from touchgoal.control.tactile.depth import DepthEstimator
from touchgoal.control.tactile.light_gain import remove_gain
from touchgoal.control.tactile.markers.tracker import without_dots
from touchgoal.control.tactile.sensor_calibration import load, shade
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.runtime.errors import UserError

# Thresholds lie between what whole images and faulty ones reach, on the real frames of three
# Minis and two DIGITs.
_SEAM, _STEP = 3.5, 6.0  # times the usual step from row to row; counts, the channels' sum
_EDGE = 10  # share of an image (1/n) at either end where a seam may be the sensor's case
# Counts, the channels' sum: in simulation the edge of a block pressed with 40 N changes a side by 17.
_MOVED = 24.0
_SEAM_PARTS = 32  # along a row, half of which must show the step
_CLEARLY = 0.85  # share of the difference that a better order or mirror may leave
_CLEARLY_MOVED = 0.75  # share of the difference that a better scale or shift may leave
_SAME_UNIT = 0.035  # difference below which the file was made from this very unit
_OPEN = 1.5  # factor on the difference within which presses have to decide
_EXPLAINS = 0.8  # share of the unexplained change that a better order or mirror may leave
# Share of a press's change that a sensor file may leave unexplained: presses on the file's own unit 0.08
# to 0.51; on another Mini (PhysiCLeAR) two thirds of them below it; that one's 103 untouched images from
# 0.72.
UNEXPLAINED = 0.65
_PRESSED = 8.0  # counts of local change; simulated units, untouched, reach 6
_PAINTED = 12.0  # counts: more than the rims of dots painted over leave
_SMOOTH = 4  # degree of the factor by which the light of two units differs
_MAX_PRESSES = 6  # number of presses that are read
_CELL = 8  # px of a cell in which changes are averaged; the finest of the depth that is read
_STRONGEST = 0.1  # share of the image over which the explanation is judged
_COARSE = 4  # px of the sensor's image to a cell of the comparison
_DARK = 8.0  # counts added before the logarithm: noise in the dark is no difference
_MOST = 0.5  # largest difference of log light that a cell counts with
_COLOURS = "red", "green", "blue"

Cells = Float32[np.ndarray, "rows columns 3"]


@dataclass(frozen=True)
class _View:
    """Hypothesis on an image: its channels in another order, mirrored, or both."""

    order: tuple[int, ...]
    rows: bool  # mirrored top to bottom
    columns: bool  # mirrored left to right

    def undo(self, image: np.ndarray) -> np.ndarray:
        """Return the image with this hypothesis undone."""
        image = image[..., list(self.order)]
        image = image[::-1] if self.rows else image
        return np.ascontiguousarray(image[:, ::-1] if self.columns else image)

    def __str__(self) -> str:
        faults = []
        exchanged = [c for c in range(3) if self.order[c] != c]
        if len(exchanged) == 2:
            names = " and ".join(_COLOURS[c] for c in exchanged)
            faults.append(f"{names} are exchanged")
        elif exchanged:
            sent = [_COLOURS[self.order.index(c)] for c in range(3)]
            faults.append(f"its channels come in the order {', '.join(sent)}")
        if self.rows and self.columns:
            faults.append("it is turned by 180 degrees")
        elif self.rows or self.columns:
            faults.append(f"it is mirrored {'top to bottom' if self.rows else 'left to right'}")
        remedy = "give RGB as the camera sees it" if exchanged else "give it as the camera sees it"
        return f"{' and '.join(faults)}: {remedy}"


_VIEWS = [_View(*v) for v in product(permutations(range(3)), (False, True), (False, True))]
_AS_IS, _OTHERS = _VIEWS[0], _VIEWS[1:]
# (scale along x, along y, shift along x, along y in cells)
_MOVES = [(x, y, 0, 0) for x, y in product((0.926, 1, 1.08), repeat=2) if (x, y) != (1, 1)]
_MOVES += [(1, 1, x, y) for x, y in product((-6, -3, 0, 3, 6), repeat=2) if (x, y) != (0, 0)]


def find_seam(image: Image, before: Image | None = None) -> str:
    """Return where half a row or column steps away, as if torn or rolled; "" if it is whole.

    A pressed edge steps as sharply, but hardly changes what lies beyond it: with the whole image
    `before` it, a step counts only where a side of it has changed altogether.
    """
    height, width, _ = image.shape
    if min(height, width) < 3 * _EDGE:  # too small to check
        return ""
    exact = image.astype(np.float32)
    sizes = {"row": (_SEAM_PARTS, height), "column": (width, _SEAM_PARTS)}
    for axis, (name, size) in enumerate(sizes.items()):
        lines, margin = np.swapaxes(image, 0, axis), image.shape[axis] // _EDGE
        light = np.swapaxes(cv2.resize(exact, size, interpolation=cv2.INTER_AREA), 0, axis)
        step = np.diff(light, axis=0)
        jump = np.abs(step[1:-1] - (step[:-2] + step[2:]) / 2).sum(2)
        usual = np.median(jump, 1)[margin:-margin]
        if usual.max() > max(_SEAM * np.quantile(usual, 0.95), _STEP):
            at = int(usual.argmax()) + margin + 2
            if before is None or _side_changed(lines, np.swapaxes(before, 0, axis), at):
                return f"it is torn or rolled at {name} {at}: check the cable and how it is decoded"
    return ""


def _side_changed(lines: Image, before: Image, at: int) -> bool:
    """Return whether the lines before or after `at` differ from another image's altogether."""
    change = cv2.subtract(lines, before, dtype=cv2.CV_32F)
    size = lines.shape[1] // _CELL, lines.shape[0] // _CELL
    cells = np.abs(cv2.resize(change, size, interpolation=cv2.INTER_AREA)).sum(2)
    sides = cells[: at // _CELL - 1], cells[at // _CELL + 2 :]
    return any(float(np.median(side)) > _MOVED for side in sides if side.size)


def check_untouched(image: Image, sensor: SensorModel, name: str) -> None:
    """Refuse an untouched RGB image that contradicts its sensor file; `name` is for the message.

    UserError if it is torn or rolled, its channels are exchanged, or it is mirrored, stretched or
    shifted.
    """
    if fault := find_seam(image) or _fault(_compare(image, sensor)):
        raise UserError(
            f"{name} is no image of a {sensor.name} as its sensor file shows it: {fault}"
        )


def check_unpressed(image: Image, sensor: SensorModel, name: str) -> None:
    """Refuse an image that is taken for untouched, but which the sensor file explains as a press.

    The file's background is first put into the light of the image; dots are painted over. `name` is for
    the UserError, which is also raised for a marker gel that shows no dots.
    """
    calibration, image = load(sensor.sensor_file), without_dots(image, sensor)
    background = in_light_of(image, calibration.background)
    change = local_change(image, background)
    least = _PAINTED if sensor.markers else _PRESSED
    if sensor.images_only or float(change.max()) < least:
        return
    read = explain(DepthEstimator(calibration, _CELL), image, background)
    if read.unexplained <= UNEXPLAINED:
        raise UserError(
            f"{name} begins in touch: its first frames are taken for the untouched gel, but the "
            "sensor file reads them as pressed; begin with nothing on the gel"
        )


def in_light_of(image: Image, background: Image) -> Counts:
    """Return a background times a smooth factor, fitted to an image by its log ratio, but for outliers."""
    rows, columns, _ = background.shape
    w, h = size = columns // _COARSE, rows // _COARSE
    small = [cv2.resize(x, size, interpolation=cv2.INTER_AREA) for x in (image, background)]
    now, before = (np.log(x.astype(np.float64) + _DARK).reshape(-1, 3) for x in small)
    v, u = np.mgrid[-1 : 1 : h * 1j, -1 : 1 : w * 1j].reshape(2, -1)
    powers = [(i, j) for i in range(_SMOOTH + 1) for j in range(_SMOOTH + 1 - i)]
    terms = np.stack([u**i * v**j for i, j in powers], 1)
    weight, fit = np.ones((h * w, 1)), np.zeros_like(now)
    for _ in range(8):
        normal = (weight * terms).T
        fit = terms @ np.linalg.lstsq(normal @ terms, normal @ (now - before), rcond=None)[0]
        off = np.linalg.norm(now - before - fit, axis=1, keepdims=True)
        weight = 1 / (1 + (off / (2 * np.median(off) + 1e-6)) ** 2)
    factor = cv2.resize(
        np.exp(fit).reshape(h, w, 3), (columns, rows), interpolation=cv2.INTER_CUBIC
    )
    return ((background + _DARK) * factor - _DARK).clip(0, 255).astype(np.float32)


def check_presses(
    untouched: Image, presses: Sequence[Image], sensor: SensorModel, name: str
) -> None:
    """Refuse presses that the sensor file explains clearly better mirrored or with other channels.

    `check_untouched` has passed the RGB image of the untouched gel; in the presses dots are
    painted over, and the strongest six are looked at. `name` is for the UserError.
    """
    differences = _compare(untouched, sensor)
    least = differences[_AS_IS]
    others = [view for view in _OTHERS if differences[view] < _OPEN * least]
    strength = [float(local_change(press, untouched).max()) for press in presses]
    chosen = [presses[i] for i in np.argsort(strength)[::-1][:_MAX_PRESSES]]
    if not others or len(chosen) < 3:
        return
    estimator = DepthEstimator(load(sensor.sensor_file), _CELL)

    def unexplained(view: _View) -> Float32[np.ndarray, " n"]:
        background = view.undo(untouched).astype(np.float32)
        read = [explain(estimator, view.undo(x), background) for x in chosen]
        return np.array([explanation.unexplained for explanation in read], np.float32)

    as_is = unexplained(_AS_IS)
    share = {view: float(np.median(unexplained(view) / as_is)) for view in others}
    best = min(share, key=lambda view: share[view])
    if share[best] < _EXPLAINS:
        raise UserError(
            f"{name} are no presses of a {sensor.name} as its sensor file shows them: {best}"
        )


@dataclass(frozen=True, eq=False)
class Explanation:
    """A frame as its sensor file explains it: depth of the gel (m), change that is left (counts).

    `unexplained` is the share that is left in the strongest tenth of the change.
    """

    depth: Map
    left: Counts
    unexplained: float


def explain(estimator: DepthEstimator, frame: Image, background: Counts) -> Explanation:
    """Read a frame's depth and compare the frame with the rendering of that depth."""
    depth = estimator.estimate(frame, background)
    change = remove_gain(frame, background) - background
    calibration = estimator.calibration
    left = change - (shade(calibration, depth) - calibration.background)
    size = frame.shape[1] // _CELL, frame.shape[0] // _CELL
    strong, rest = (cv2.resize(x, size, interpolation=cv2.INTER_AREA) for x in (change, left))
    where = np.abs(strong).sum(2)
    where = where >= np.quantile(where, 1 - _STRONGEST)
    share = float(np.abs(rest[where]).mean() / max(float(np.abs(strong[where]).mean()), 1e-6))
    return Explanation(depth, left, share)


def _compare(image: Image, sensor: SensorModel) -> dict[_View | tuple, float]:
    """Return the difference from the sensor file's image under each hypothesis."""
    reference = _coarse(load(sensor.sensor_file).background, sensor)
    given = _coarse(image, sensor)
    differences: dict[_View | tuple, float] = {
        view: _difference(view.undo(given), reference) for view in _VIEWS
    }
    for move in _MOVES:
        differences[move] = _difference(_moved(given, *move), reference)
    return differences


def _fault(differences: dict[_View | tuple, float]) -> str:
    """Name the hypothesis that fits clearly better than none; "" if there is none."""
    as_is = differences[_AS_IS]
    best = min(differences, key=lambda hypothesis: differences[hypothesis])
    if isinstance(best, _View):
        return str(best) if differences[best] < _CLEARLY * as_is else ""
    if differences[best] > min(_CLEARLY_MOVED * as_is, _SAME_UNIT):
        return ""
    x, y, right, down = best
    if (x, y) != (1, 1):
        return (
            f"it fits when scaled by {x:g} along its rows and {y:g} along its columns: cut and "
            "scale it as when the sensor file was made"
        )
    return (
        f"it fits when moved by about {_COARSE * right} px to the right and {_COARSE * down} px "
        "down: cut it as when the sensor file was made, or check whether the gel has slipped"
    )


def _coarse(image: Image, sensor: SensorModel) -> Cells:
    """Return the logarithm of light on coarse cells, without printed dots."""
    rows, columns = sensor.image_shape
    size = columns // _COARSE, rows // _COARSE
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    if sensor.markers is not None:
        dot = 2 * round(0.75 * sensor.markers.diameter / sensor.pixel_pitch / _COARSE) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (dot, dot))
        small = cv2.morphologyEx(small, cv2.MORPH_CLOSE, disc)
    return np.log(cv2.GaussianBlur(small.astype(np.float32), (0, 0), 1.0) + _DARK)


def _difference(one: Cells, other: Cells) -> float:
    """Return the mean difference without each channel's gain; single spots count little."""
    change = one - other
    change -= np.median(change.reshape(-1, 3), 0)
    return float(np.minimum(np.abs(change), _MOST).mean())


def _moved(image: Cells, x: float, y: float, right: float, down: float) -> Cells:
    """Scale an image about its middle, then shift it; border pixels are replicated."""
    height, width, _ = image.shape
    affine = np.array(
        [[x, 0, (1 - x) * width / 2 + right], [0, y, (1 - y) * height / 2 + down]], np.float32
    )
    return cv2.warpAffine(image, affine, (width, height), borderMode=cv2.BORDER_REPLICATE)
