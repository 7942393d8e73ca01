"""A folder of ball presses, from which a sensor is calibrated."""

import csv
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from touchgoal.control.arrays import Circle, Circles, Image, Images
from touchgoal.control.calibration.ball import find_circle, squared_distance
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import read_image, write_image

COLUMNS = ("file", "x_px", "y_px", "radius_px", "ball_mm")
# Twelve are fitted and four held out. With fewer, the 30 response terms of a channel overfit single
# presses. With twelve, the held-out error on GelSight is a tenth above that with 36.
MINIMUM = 16
# A pressed ball changes the image by tens of counts. Camera noise is about 1 count (0.5 in the
# mean of a few hundred pixels); slow drift of the light reached 7.
_VISIBLE = 10.0
_FAR = 3.0  # contact radii beyond which a press does not change the image
_LINE_ROUNDS, _LINE_TOLERANCE = 4, 1.0  # rounds and tolerance (counts) of the robust line


@dataclass(frozen=True)
class PressSet:
    """Images of one ball pressed into one sensor."""

    background: Image  # the untouched sensor, RGB
    images: Images  # the presses, RGB
    # contact circles as given or found: centre x (column), centre y (row) and radius, px; the
    # centre of the first pixel is (0, 0)
    circles: Circles
    ball_radius: Float[np.ndarray, " n"]  # m, one per press; all NaN if not known
    files: tuple[str, ...]  # name of each image
    labelled: bool = True  # whether the circles were given, not found in the images

    def __len__(self) -> int:
        return len(self.images)

    def take(self, chosen: Int[np.ndarray, " m"]) -> "PressSet":
        """Return some of the presses, by index."""
        return replace(
            self,
            images=self.images[chosen],
            circles=self.circles[chosen],
            ball_radius=self.ball_radius[chosen],
            files=tuple(self.files[i] for i in chosen),
        )


def split(presses: PressSet, n_held_out: int, seed: int) -> tuple[PressSet, PressSet]:
    """Draw presses to fit and presses to judge the fit on."""
    order = np.random.default_rng(seed).permutation(len(presses))
    return presses.take(np.sort(order[n_held_out:])), presses.take(np.sort(order[:n_held_out]))


def write_presses(presses: PressSet, folder: Path, adds: bool = False) -> None:
    """Write the folder that `read_presses` reads, or add presses to it with a new background."""
    write_image(folder / "background.png", presses.background)
    with (folder / "presses.csv").open("a" if adds else "w", newline="") as file:
        rows = csv.writer(file)
        if file.tell() == 0:
            rows.writerow(COLUMNS)
        for name, image, circle, ball in zip(
            presses.files, presses.images, presses.circles, presses.ball_radius, strict=True
        ):
            write_image(folder / name, image)
            known = "" if math.isnan(ball) else f"{ball * 1e3:g}"
            rows.writerow([name, *(f"{v:g}" for v in circle), known])


def read_presses(folder: Path, pitch: float, ball_mm: float = math.nan) -> PressSet:
    """Read `background.png`, `presses.csv` and the images it names, in the background's light.

    Without `presses.csv` every other image is a press. Circles that the table lacks are found.
    `pitch` is m per pixel; `ball_mm` is the radius (mm) of balls that the table does not give.
    UserError if something is missing, does not fit together, or is too little to calibrate from.
    """
    background = _read_image(folder / "background.png")
    rows = _read_rows(folder, ball_mm)
    if len(rows) < MINIMUM:
        raise UserError(
            f"{folder} has {len(rows)} presses, calibration needs at least {MINIMUM} (12 to fit the "
            "30 response terms of a colour, 4 to check them): add presses at other places"
        )
    files, labels, balls = zip(*rows, strict=True)
    ball, labelled = np.array(balls) * 1e-3, [not np.isnan(circle).any() for circle in labels]
    if np.isnan(ball).any():
        raise UserError(
            "the ball's radius is missing, and every depth in mm depends on it: measure the ball "
            "and give --ball-mm, or ball_mm in presses.csv (two balls of different size are best)"
        )
    images, circles = [], []
    for file, circle, known, radius in zip(files, labels, labelled, ball, strict=True):
        image = _read_image(folder / file)
        if image.shape != background.shape:
            raise UserError(
                f"{folder / file} has {image.shape[1]} x {image.shape[0]} pixels, background.png "
                f"{background.shape[1]} x {background.shape[0]}: record them at the same size"
            )
        try:
            found = circle if known else find_circle(image, background)
        except UserError as error:
            raise UserError(f"{file}: {error}") from error
        _check_circle(file, found, radius, background.shape, pitch)
        _check_visible(file, found, image, background)
        circles.append(found)
        images.append(without_drift(image, background, found))
    stacked, contacts = np.stack(images), np.stack(circles)
    return PressSet(background, stacked, contacts, ball, files, any(labelled))


def _read_rows(folder: Path, ball_mm: float) -> list[tuple[str, Circle, float]]:
    """Return file, circle (px) and ball's radius (mm) of each press; NaN for an empty cell."""
    path = folder / "presses.csv"
    if not path.is_file():
        if math.isnan(ball_mm):
            raise UserError(
                f"{path} is missing: give --ball-mm if one ball made all presses, or write one line "
                "per press with the columns file,ball_mm (docs/own_sensor.md)"
            )
        images = {p.name for p in folder.iterdir() if p.suffix.lower() in (".png", ".jpg")}
        unknown = np.full(3, math.nan)
        return [(name, unknown, ball_mm) for name in sorted(images - {"background.png"})]
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        if "file" not in (reader.fieldnames or ()):
            raise UserError(
                f"{path} lacks the column file: its first line must be file,ball_mm or "
                f"{','.join(COLUMNS)} (docs/own_sensor.md)"
            )
        return [_read_row(path, line, row, ball_mm) for line, row in enumerate(reader, 2)]


def _read_row(
    path: Path, line: int, row: dict[str, str], ball_mm: float
) -> tuple[str, Circle, float]:
    try:
        x, y, radius, ball = (float((row.get(name) or "").strip() or "nan") for name in COLUMNS[1:])
    except ValueError as error:
        raise UserError(
            f"{path}, line {line}: {error}; write numbers, or leave them out"
        ) from error
    return row["file"], np.array([x, y, radius]), ball_mm if math.isnan(ball) else ball


def _read_image(path: Path) -> Image:
    image = read_image(path)
    if image is None:
        raise UserError(
            f"{path} is missing or no image: a folder of presses needs background.png and the "
            "images of the presses"
        )
    return image


def _check_circle(
    name: str, circle: np.ndarray, ball: float, shape: tuple[int, ...], pitch: float
) -> None:
    x, y, radius = circle
    if not (np.isfinite(circle).all() and radius >= 3):
        raise UserError(
            f"presses.csv, {name}: a contact radius of {radius:g} px is too small to show slopes; "
            "press harder or record at full resolution"
        )
    if not (0 <= x < shape[1] and 0 <= y < shape[0]):
        raise UserError(
            f"presses.csv, {name}: the circle's centre ({x:g}, {y:g}) px lies outside the "
            f"{shape[1]} x {shape[0]} image"
        )
    if radius * pitch >= ball:
        raise UserError(
            f"presses.csv, {name}: a contact radius of {radius * pitch * 1e3:.2f} mm ({radius:g} px "
            f"at {pitch * 1e3:g} mm/px) does not fit a ball of radius {ball * 1e3:g} mm: check "
            "ball_mm (a radius, not a diameter) and the scale"
        )


def _check_visible(
    name: str, circle: np.ndarray, image: np.ndarray, background: np.ndarray
) -> None:
    inside = squared_distance(image.shape, circle) < circle[2] ** 2
    change = image[inside].astype(np.float32) - background[inside]
    if np.percentile(np.abs(change), 90) < _VISIBLE:
        raise UserError(
            f"{name} shows no contact in its circle (less than {_VISIBLE:g} counts from "
            "background.png): drop it, or record the background again"
        )


def without_drift(image: Image, background: Image, circle: Circle) -> Image:
    """Return a press as it would look in the background's light.

    Each channel loses gain and offset of a robust line through the pixels far from the contact's
    `circle` (px).
    """
    far = squared_distance(image.shape, circle) > (_FAR * circle[2]) ** 2
    if far.mean() < 0.1:
        return image
    steady = np.empty_like(image)
    for channel in range(3):
        gain, offset = _line(background[far, channel], image[far, channel])
        steady[..., channel] = np.rint((image[..., channel] - offset) / gain).clip(0, 255)
    return steady


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Fit gain and offset by least absolute error."""
    terms = np.stack([x, np.ones(len(x))], 1).astype(np.float64)
    weight, solved = np.ones(len(x)), np.array([1.0, 0.0])
    for _ in range(_LINE_ROUNDS):
        weighted = terms * weight[:, None]
        solved = np.linalg.solve(terms.T @ weighted + 1e-6 * np.eye(2), weighted.T @ y)
        weight = 1 / np.maximum(np.abs(y - terms @ solved), _LINE_TOLERANCE)
    return float(solved[0]), float(solved[1])
