"""Dots printed on a gel: detection, tracking, and removal from an image."""

from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from jaxtyping import Float32, Int

from touchgoal.control.arrays import AnyImage, Image
from touchgoal.control.tactile.markers.matching import Dots, Flags, Spots, average_neighbours, match
from touchgoal.control.tactile.sensor_models import MarkerGrid, SensorModel
from touchgoal.runtime.errors import UserError

_FAINTEST = 0.5  # share of the usual darkness; a fainter spot is no dot
_LEAST_FOUND = 0.7  # share of the grid's dots that a marker gel must show
# Of another gel's or crop's grid, against the sensor's.
_SCALES = (1.0, 1.25, 0.8, 1.55, 0.65, 1.95)
_FEWEST, _SPAN = 12, 0.5  # dots of another grid; share of the image's width and height it covers
_TURN = np.radians(35)  # of a grid, at most
_CROOKED = 0.15  # of its spacing: usual distance from a straight lattice, above which it is none
_NOISE = 0.02  # darkness of a spot that may be noise
_RIM = 2.0  # px around a dot's nominal radius that may still be dark
_UNKNOWN = -(10**6)  # cell of a spot that is no dot
_LARGER = 1.1  # factor on the nominal radius: largest dots of another gel

Grey = Float32[np.ndarray, "h w 1"]


@dataclass(frozen=True)
class Markers:
    """Grid of dots in one frame: (x, y) of the centres in px, pixel centres at integers.

    `positions` holds the expected ones where a dot was not `found`.
    """

    positions: Dots
    found: Flags
    diameter: float  # of a dot, nominal, px

    def largest_radius(self, grid: MarkerGrid) -> float:
        """Return the radius (px) that covers such dots on an untouched gel, from their spacing."""
        spacing = np.median(np.linalg.norm(np.diff(self.positions, axis=1), axis=-1))
        return float(_LARGER * spacing * grid.diameter / grid.pitch / 2)


class MarkerTracker:
    """Tracker of one gel's dots: at `rest` in an untouched RGB frame, and `now`, in the last one.

    The dots are expected to stay, to keep moving, or else to be back at rest or to have jumped by
    up to half a spacing, turned and sheared, whichever explains the frame best (`markers.matching`).
    A dot that no spot fits is lost, which is flagged; it is expected where its neighbours'
    displacement carries it. The grid is the one that `find_markers` finds; `pixel_pitch` is m per px.
    UserError if the untouched frame shows none.
    """

    def __init__(self, untouched: Image, grid: MarkerGrid, pixel_pitch: float) -> None:
        self.rest = self.now = find_markers(untouched, grid, pixel_pitch)
        self._size = self.rest.diameter
        _, darkness = _spots(_grey(untouched), self._size)
        self._faintest = _FAINTEST * _usual(darkness, self.rest.found.size)
        steps = np.diff(self.rest.positions, axis=1)
        self._spacing = float(np.median(np.linalg.norm(steps, axis=-1)))
        self._motion = np.zeros_like(self.rest.positions)

    @property
    def displacement(self) -> Dots:
        """Displacement of each dot from its rest, px."""
        return self.now.positions - self.rest.positions

    def update(self, frame: Image) -> Markers:
        """Find the dots in the next frame."""
        before = self.now.positions
        grey = _grey(frame)
        spots, darkness = _spots(grey, self._size)
        spots = spots[darkness > self._faintest]
        centres = _refined(grey, spots, self._size / 2)
        # Steep shading may throw the first centre off by several pixels.
        off = (np.rint(centres) != np.rint(spots)).any(1)
        centres[off] = _refined(grey, centres[off], self._size / 2)
        starts = [before, before + self._motion, self.rest.positions]
        height, width, _ = frame.shape
        positions, found = match(starts, centres, self._spacing, (width, height))
        if found.any():
            moved = average_neighbours(positions - self.rest.positions, found)
            positions[~found] = (self.rest.positions + moved)[~found]
        self._motion = positions - before
        self.now = Markers(positions, found, self._size)
        return self.now


def find_markers(image: Image, grid: MarkerGrid, pixel_pitch: float) -> Markers:
    """Find the dots of an untouched gel, by rows (downwards) and columns (rightwards).

    The grid may be rotated by up to 30 degrees and shifted. Rows, columns and pitch are the sensor's
    (to a fifth; `pixel_pitch` is m per px) if 70 % of those dots are visible, some of each row and
    column; else the image's: the largest straight grid of 0.65 to 1.95 times that pitch. UserError
    if there is none.
    """
    grey = _grey(image)
    expected = _find(grey, grid, pixel_pitch, grid.rows * grid.columns)
    seen = expected.found
    if seen.mean() >= _LEAST_FOUND and seen.any(0).all() and seen.any(1).all():
        return expected
    others = [_find(grey, grid, pixel_pitch / scale) for scale in _SCALES]
    others = [other for other in others if _is_grid(other, grey)]
    if not others:
        raise UserError(
            f"only {seen.sum()} of {seen.size} markers are visible, and no grid of other rows, "
            "columns or pitch: check that the sensor has a marker gel and that nothing touches it"
        )
    return max(others, key=lambda other: int(other.found.sum()))


def _find(grey: Grey, grid: MarkerGrid, pixel_pitch: float, count: int | None = None) -> Markers:
    """Find a grid of the sensor's pitch, and of its rows and columns if it has the `count` of dots."""
    size = grid.diameter / pixel_pitch
    spots, darkness = _spots(grey, size)
    usual = _usual(darkness, count or int(grey.size * (pixel_pitch / grid.pitch) ** 2))
    spots = _refined(grey, spots[darkness > _FAINTEST * usual], size / 2)
    cells = _ordered(spots, grid.pitch / pixel_pitch)
    known = cells[cells[:, 0] > _UNKNOWN]
    if count is None:
        columns, rows = (_lines(known[:, axis]) for axis in (0, 1))
        grid = replace(grid, rows=rows, columns=columns)
    positions = np.zeros((grid.rows, grid.columns, 2), np.float32)
    found = np.zeros((grid.rows, grid.columns), bool)
    if len(known):
        cells = cells - _fullest(known, grid)
        inside = ((cells >= 0) & (cells < [grid.columns, grid.rows])).all(1)
        column, row = cells[inside].T
        positions[row, column] = spots[inside]
        found[row, column] = True
        positions[~found] = _straight(positions, found)[~found]
    return Markers(positions, found, size)


def _lines(cells: Int[np.ndarray, " n"]) -> int:
    """Return the number of rows, or columns, with at least half as many dots as the fullest one."""
    if not len(cells):
        return 0
    full = np.bincount(cells - cells.min())
    return int((2 * full >= full.max()).sum())


def _is_grid(markers: Markers, grey: Grey) -> bool:
    """Return whether spots are a grid that covers the image, rather than noise or a texture."""
    places, found = markers.positions, markers.found
    if found.sum() < _FEWEST or min(found.shape) < 3 or found.mean() < _LEAST_FOUND:
        return False
    height, width, _ = grey.shape
    off = np.linalg.norm(places - _straight(places, found), axis=-1)[found]
    spacing = np.median(np.linalg.norm(np.diff(places, axis=1), axis=-1))
    wide = (np.ptp(places, (0, 1)) > _SPAN * np.array([width, height])).all()
    return bool(wide and np.median(off) < _CROOKED * spacing)


def _straight(positions: Dots, found: Flags) -> Dots:
    """Return the straight lattice that fits the dots found best, px."""
    row, column = np.indices(found.shape)
    terms = np.stack([np.ones_like(row), column, row], -1).astype(np.float32)
    return terms @ np.linalg.lstsq(terms[found], positions[found], rcond=None)[0]


def without_dots(untouched: Image, sensor: SensorModel) -> Image:
    """Paint a sensor's dots, if it has any, over in an untouched image; UserError if it shows none."""
    grid = sensor.markers
    if grid is None:
        return untouched
    dots = find_markers(untouched, grid, sensor.pixel_pitch)
    return without_markers(untouched, dots.positions, dots.largest_radius(grid))


def without_markers(
    image: AnyImage, centres: Float32[np.ndarray, "*n 2"], radius: float
) -> AnyImage:
    """Paint dots of a radius (px), and a rim of 2 px, over with a membrane between their rims.

    `centres` are (x, y) in px, such as `Markers.positions`.
    """
    h, w, _ = image.shape
    centres = centres.reshape(-1, 2)
    near = ((centres > -radius) & (centres < np.array([w, h]) + radius)).all(1)
    padded, margin = _padded(image, radius)
    pixels, membrane = _under_dots(padded, centres[near] + margin, radius)
    padded[pixels] = np.rint(membrane) if image.dtype == np.uint8 else membrane
    return padded[margin : margin + h, margin : margin + w]


def _grey(image: Image) -> Grey:
    return cv2.transform(image.astype(np.float32), np.full((1, 3), 1 / 3, np.float32))[..., None]


def _usual(darkness: Float32[np.ndarray, " n"], count: int) -> float:
    """Return the median darkness of the darkest spots, `count` of them."""
    darkest = np.sort(darkness)[-count:]
    return float(np.median(darkest)) if len(darkest) else 0.0


def _spots(grey: Grey, size: float) -> tuple[Spots, Float32[np.ndarray, " n"]]:
    """Find dark spots of about `size` px: (x, y) of their centres and their darkness, 0 to 1.

    Darkness is the share of light missing against the surroundings, blurred to the size of a spot;
    a parabola through its peak gives the centre.
    """
    scale = max(int(size / 7), 1)  # dots of 7 px are found as well as larger ones, and faster
    h, w, _ = grey.shape
    size /= scale
    width = 2 * round(0.7 * size) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    light = cv2.resize(grey, (w // scale, h // scale), interpolation=cv2.INTER_AREA)
    light = cv2.GaussianBlur(light, (0, 0), 0.5)
    around = cv2.morphologyEx(light, cv2.MORPH_CLOSE, kernel)
    dark = cv2.GaussianBlur((around - light) / np.maximum(around, 1), (0, 0), size / 3)
    peak = (dark == cv2.dilate(dark, kernel)) & (dark > _NOISE)
    peak[[0, -1]] = peak[:, [0, -1]] = False
    y, x = np.nonzero(peak)
    centre = np.stack([x, y], axis=1).astype(np.float32)
    for axis, (dy, dx) in enumerate(((0, 1), (1, 0))):
        low, middle, high = dark[y - dy, x - dx], dark[y, x], dark[y + dy, x + dx]
        centre[:, axis] += 0.5 * (high - low) / np.maximum(2 * middle - low - high, 1e-6)
    return centre * scale + np.float32((scale - 1) / 2), dark[y, x]


def _refined(grey: Grey, spots: Spots, radius: float) -> Spots:
    """Return each spot's centroid of darkness below its membrane: shading does not shift it."""
    padded, margin = _padded(grey, radius)
    (y, x), membrane = _under_dots(padded, spots + margin, radius)
    dark = np.maximum(1 - padded[y, x, 0] / np.maximum(membrane[..., 0], 1), 0)
    dark /= np.maximum(dark.sum(1, keepdims=True), 1e-6)
    return np.stack([(dark * x).sum(1), (dark * y).sum(1)], 1).astype(np.float32) - margin


def _ordered(spots: Spots, pitch: float) -> Int[np.ndarray, "n 2"]:
    """Return (column, row) of each spot from the middlemost; far outside if not connected to it."""
    cells = np.full((len(spots), 2), _UNKNOWN)
    if not len(spots):
        return cells
    apart = spots[None] - spots[:, None]
    distance = np.linalg.norm(apart, axis=-1)
    close = np.abs(distance - pitch) < 0.25 * pitch
    along = np.arctan2(apart[close][:, 1], apart[close][:, 0])
    # Steps on a lattice differ by right angles, so four times their angle is the same for all.
    angle = np.angle(np.exp(4j * along).sum()) / 4
    if abs(angle) > _TURN:  # steps are the diagonals of a finer grid
        return cells
    step = float(np.median(distance[close])) if close.any() else pitch
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    lattice = apart @ turn.T / step
    hop = np.rint(lattice).astype(int)
    near = (np.abs(hop).sum(-1) == 1) & (np.linalg.norm(lattice - hop, axis=-1) < 0.3)
    start = int(np.linalg.norm(spots - np.median(spots, axis=0), axis=1).argmin())
    cells[start] = 0
    reached = [start]
    for spot in reached:
        for other in np.flatnonzero(near[spot]):
            if cells[other, 0] == _UNKNOWN:
                cells[other] = cells[spot] + hop[spot, other]
                reached.append(int(other))
    return cells


def _fullest(cells: Int[np.ndarray, "n 2"], grid: MarkerGrid) -> Int[np.ndarray, "2"]:
    """Return the first (column, row) of the grid-sized window with most cells."""
    corners = [
        np.array([column, row])
        for column in range(cells[:, 0].min(), cells[:, 0].max() + 1)
        for row in range(cells[:, 1].min(), cells[:, 1].max() + 1)
    ]
    size = np.array([grid.columns, grid.rows])
    return max(corners, key=lambda c: int(((cells >= c) & (cells < c + size)).all(1).sum()))


def _padded(image: np.ndarray, radius: float) -> tuple[np.ndarray, int]:
    """Return the image with a margin that holds any dot touching it, and the margin."""
    m = int(2 * radius + _RIM) + 3
    padded = cv2.copyMakeBorder(image, m, m, m, m, cv2.BORDER_REPLICATE)
    return padded.reshape(*padded.shape[:2], image.shape[2]), m


def _under_dots(
    image: np.ndarray, centres: Spots, radius: float
) -> tuple[
    tuple[Int[np.ndarray, "n inner"], Int[np.ndarray, "n inner"]],
    Float32[np.ndarray, "n inner channels"],
]:
    """Return (rows, columns) of the pixels under dots, and the membrane there."""
    inner, ring, weights = _membrane(radius + _RIM)
    at = np.rint(centres).astype(int)[:, None]
    x, y = np.moveaxis(at + inner, -1, 0)
    rim_x, rim_y = np.moveaxis(at + ring, -1, 0)
    return (y, x), weights @ image[rim_y, rim_x].astype(np.float32)


@cache
def _membrane(
    radius: float,
) -> tuple[
    Int[np.ndarray, "inner 2"], Int[np.ndarray, "ring 2"], Float32[np.ndarray, "inner ring"]
]:
    """Return offsets (x, y) of a disc and of the ring around it, and the harmonic weights."""
    reach = int(radius) + 2
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = (x * x + y * y <= radius * radius).astype(np.uint8)
    around = cv2.dilate(disc, cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))) - disc
    inner, ring = (np.stack([x[m > 0], y[m > 0]], 1) for m in (disc, around))
    next_to = (np.abs(inner[:, None] - inner).sum(-1) == 1).astype(np.float64)
    laplace = 4 * np.eye(len(inner)) - next_to
    boundary = (np.abs(inner[:, None] - ring).sum(-1) == 1).astype(np.float64)
    return inner, ring, np.linalg.solve(laplace, boundary).astype(np.float32)
