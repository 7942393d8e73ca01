"""A folder of labelled ball presses, from which a sensor's light is calibrated."""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from touchgoal.control.calibration.ball import find_circle
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.picture_file import read_picture

COLUMNS = ("file", "x_px", "y_px", "radius_px", "ball_mm")
_NEEDED = ("file",)
# Twelve are fitted and four held out: with fewer, the 30 response terms of a channel follow single
# presses, and the held-out error of the GelSight presses is a tenth above that of 36.
MINIMUM = 16
# A pressed ball changes the picture by tens of counts. Camera noise is about 1 count, half of it
# in the mean of a few hundred pixels; slow drift of the light reached 7.
_VISIBLE = 10.0
_FAR = 3.0  # contact radii beyond which a press leaves the gel at rest
_LINE_ROUNDS, _LINE_TOLERANCE = 4, 1.0  # of the robust line; counts


@dataclass(frozen=True)
class PressSet:
    """Pictures of one ball pressed into one sensor.

    Attributes:
        background: the untouched sensor, RGB.
        images: the presses, RGB.
        circles: where the ball touches the gel as labelled: centre x (column), centre y (row) and
            radius, px; the centre of the first pixel is (0, 0).
        ball_radius: m, one a press; all NaN if not known.
        files: name of each picture.
    """

    background: UInt8[np.ndarray, "h w 3"]
    images: UInt8[np.ndarray, "n h w 3"]
    circles: Float[np.ndarray, "n 3"]
    ball_radius: Float[np.ndarray, " n"]
    files: tuple[str, ...]

    def __len__(self) -> int:
        """Number of presses."""
        return len(self.images)

    def take(self, chosen: Int[np.ndarray, " m"]) -> "PressSet":
        """Some of the presses, by index."""
        circles, balls = self.circles[chosen], self.ball_radius[chosen]
        files = tuple(self.files[i] for i in chosen)
        return PressSet(self.background, self.images[chosen], circles, balls, files)


def split(presses: PressSet, n_held_out: int, seed: int) -> tuple[PressSet, PressSet]:
    """Presses to fit, and presses to judge the fit on."""
    order = np.random.default_rng(seed).permutation(len(presses))
    return presses.take(np.sort(order[n_held_out:])), presses.take(np.sort(order[:n_held_out]))


def write_presses(presses: PressSet, folder: Path, adds: bool = False) -> None:
    """Make the folder that `read_presses` reads, or add to its presses; the background is the new one."""
    folder.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / "background.png"), presses.background[..., ::-1])
    with (folder / "presses.csv").open("a" if adds else "w", newline="") as file:
        rows = csv.writer(file)
        if file.tell() == 0:
            rows.writerow(COLUMNS)
        for name, image, circle, ball in zip(
            presses.files, presses.images, presses.circles, presses.ball_radius, strict=True
        ):
            cv2.imwrite(str(folder / name), image[..., ::-1])
            known = "" if math.isnan(ball) else f"{ball * 1e3:g}"
            rows.writerow([name, *(f"{v:g}" for v in circle), known])


def read_presses(folder: Path, pitch: float, ball_mm: float = math.nan) -> PressSet:
    """Read `background.png`, `presses.csv` and the pictures it names, in the background's light.

    Circles that the table leaves open are found in the pictures.

    Args:
        folder: what to read.
        pitch: m per pixel.
        ball_mm: radius of the ball of presses for which the table gives none, mm.

    Raises:
        UserError: something is missing, does not fit together, or cannot be calibrated from.
    """
    background = _read_image(folder / "background.png")
    rows = _read_rows(folder / "presses.csv")
    if len(rows) < MINIMUM:
        raise UserError(
            f"{folder} has {len(rows)} presses, calibration needs at least {MINIMUM} (12 to fit the "
            "30 response terms of a colour, 4 to check them): add presses at other places"
        )
    names = tuple(row[0] for row in rows)
    ball = np.array([row[4] for row in rows])
    ball = np.where(np.isnan(ball), ball_mm, ball) * 1e-3
    images, circles = [], []
    for name, given, radius in zip(names, (row[1:4] for row in rows), ball, strict=True):
        image = _read_image(folder / name)
        if image.shape != background.shape:
            raise UserError(
                f"{folder / name} has {image.shape[1]} x {image.shape[0]} pixels, background.png "
                f"{background.shape[1]} x {background.shape[0]}: record them at the same size"
            )
        circle = _found(name, image, background) if np.isnan(given).any() else np.array(given)
        _check_circle(name, circle, radius, background.shape, pitch)
        _check_visible(name, circle, image, background)
        circles.append(circle)
        images.append(without_drift(image, background, circle))
    if np.isnan(ball).any() and not np.isnan(ball).all():
        raise UserError("presses.csv gives ball_mm for some presses only: fill in all, or none")
    return PressSet(background, np.stack(images), np.stack(circles), ball, names)


def _found(name: str, image: np.ndarray, background: np.ndarray) -> np.ndarray:
    try:
        return find_circle(image, background)
    except UserError as error:
        raise UserError(f"{name}: {error}") from error


def _read_rows(path: Path) -> list[tuple[str, float, float, float, float]]:
    if not path.is_file():
        raise UserError(f"{path} is missing: write one line a press: {','.join(COLUMNS)}")
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        missing = [name for name in _NEEDED if name not in (reader.fieldnames or ())]
        if missing:
            raise UserError(f"{path} lacks the column {missing[0]}: its first line must be file,ball_mm "
                            f"or {','.join(COLUMNS)}")  # fmt: skip
        return [_read_row(path, line, row) for line, row in enumerate(reader, 2)]


def _read_row(path: Path, line: int, row: dict[str, str]) -> tuple[str, float, float, float, float]:
    try:
        x, y, radius, ball = (_number(row.get(name)) for name in COLUMNS[1:])
    except (TypeError, ValueError) as error:
        raise UserError(
            f"{path}, line {line}: {error}; write numbers, or leave them out"
        ) from error
    return row["file"], x, y, radius, ball


def _number(text: str | None) -> float:
    return float(text) if (text or "").strip() and text is not None else math.nan


def _read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    image = read_picture(path)
    if image is None:
        raise UserError(f"{path} is missing or no picture: a folder of presses needs "
                        "background.png, presses.csv and the pictures it names")  # fmt: skip
    return image


def _check_circle(
    name: str, circle: np.ndarray, ball: float, shape: tuple[int, ...], pitch: float
) -> None:
    x, y, radius = circle
    if not (np.isfinite(circle).all() and radius >= 3):
        raise UserError(f"presses.csv, {name}: a contact radius of {radius:g} px is too small to "
                        "show slopes; press harder or record at full resolution")  # fmt: skip
    if not (0 <= x < shape[1] and 0 <= y < shape[0]):
        raise UserError(f"presses.csv, {name}: the circle's centre ({x:g}, {y:g}) px lies outside "
                        f"the {shape[1]} x {shape[0]} picture")  # fmt: skip
    if radius * pitch >= ball:
        raise UserError(
            f"presses.csv, {name}: a contact radius of {radius * pitch * 1e3:.2f} mm ({radius:g} px "
            f"at {pitch * 1e3:g} mm/px) does not fit a ball of radius {ball * 1e3:g} mm: check "
            "ball_mm (a radius, not a diameter) and the scale"
        )


def _check_visible(
    name: str, circle: np.ndarray, image: np.ndarray, background: np.ndarray
) -> None:
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    inside = (columns - circle[0]) ** 2 + (rows - circle[1]) ** 2 < circle[2] ** 2
    change = image[inside].astype(np.float32) - background[inside]
    if np.percentile(np.abs(change), 90) < _VISIBLE:
        raise UserError(f"{name} shows no contact in its circle (less than {_VISIBLE:g} counts from "
                        "background.png): drop it, or record the background again")  # fmt: skip


def without_drift(
    image: UInt8[np.ndarray, "h w 3"],
    background: UInt8[np.ndarray, "h w 3"],
    circle: Float[np.ndarray, "3"],
) -> UInt8[np.ndarray, "h w 3"]:
    """A press as it would look in the background's light.

    Gain and offset of each channel, by a robust line through the pixels far from the contact.

    Args:
        image: RGB picture of a press.
        background: the sensor untouched.
        circle: of the contact, px.
    """
    x, y, radius = circle
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    far = (columns - x) ** 2 + (rows - y) ** 2 > (_FAR * radius) ** 2
    if far.mean() < 0.1:
        return image
    steady = np.empty_like(image)
    for channel in range(3):
        gain, offset = _line(background[far, channel], image[far, channel])
        steady[..., channel] = np.rint((image[..., channel] - offset) / gain).clip(0, 255)
    return steady


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Gain and offset with the least absolute error."""
    terms = np.stack([x, np.ones(len(x))], 1).astype(np.float64)
    weight, solved = np.ones(len(x)), np.array([1.0, 0.0])
    for _ in range(_LINE_ROUNDS):
        weighted = terms * weight[:, None]
        solved = np.linalg.solve(terms.T @ weighted + 1e-6 * np.eye(2), weighted.T @ y)
        weight = 1 / np.maximum(np.abs(y - terms @ solved), _LINE_TOLERANCE)
    return float(solved[0]), float(solved[1])
