"""Fit a sensor's light, gel and noise to ball presses, and write its sensor file.

PRESSES holds background.png (the untouched sensor), the pictures of the presses, and presses.csv
with the columns file, x_px, y_px, radius_px (centre and radius of the circle in which ball and gel
touch; the first pixel is 0, 0) and ball_mm (the ball's radius; empty if not known).
"""

import shlex
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import tyro
from tqdm import tqdm

from touchgoal.control.calibration.calibrate import STEPS, FittedCalibration, fit
from touchgoal.control.calibration.picture_errors import (
    PictureErrors,
    mean_errors,
    picture_errors,
)
from touchgoal.control.calibration.pictures import light_compass, side_by_side
from touchgoal.control.calibration.press_set import PressSet, read_presses, split
from touchgoal.control.errors import UserError
from touchgoal.control.tactile.sensor_calibration import save
from touchgoal.control.tactile.sensor_models import SENSORS
from touchgoal.launch.run_folder import open_run, write_json

_MAX_SHOWN = 6  # held-out presses in the picture


@dataclass(frozen=True)
class Config:
    """Options of calibrate."""

    presses: Annotated[Path, tyro.conf.Positional]
    """Folder of presses."""
    mm_per_pixel: float
    """Millimetres of gel per pixel."""
    sensor: str = "gelsight_mini"
    """Which sensor model it is."""
    out: Path | None = None
    """Folder of the run; the sensor file goes to its `sensor_file/`."""
    held_out: float = 0.25
    """Share of the presses that the reported errors are measured on."""
    seed: int = 0
    """Which presses these are."""
    source: str = ""
    """Where the presses come from, for the record."""


def main(config: Config) -> None:
    """Fit without the held-out presses and judge on them, then fit all; UserError for bad input."""
    if config.sensor not in SENSORS:
        raise UserError(f"unknown sensor {config.sensor!r}; choose from: {', '.join(SENSORS)}")
    if not config.mm_per_pixel > 0:
        raise UserError("--mm-per-pixel must be positive: millimetres of gel per pixel")
    if not 0.1 <= config.held_out <= 0.5:
        raise UserError("--held-out must lie between 0.1 and 0.5")
    pitch = config.mm_per_pixel * 1e-3
    presses = read_presses(config.presses, pitch)
    out = open_run(config.out, "calibrate", config)
    train, test = split(presses, round(config.held_out * len(presses)), config.seed)
    with tqdm(total=2 * STEPS, desc="fit") as bar:
        judged = fit(train, pitch, config.sensor, bar.update)
        fitted = fit(presses, pitch, config.sensor, bar.update)
    errors = _held_out_errors(judged, test)
    print(_table(errors, len(test)))
    for line in _warnings(fitted):
        print(line)
    record = _record(fitted, presses, errors, len(test))
    command = shlex.join(["touchgoal", *sys.argv[1:]])
    source = {"source": config.source or str(config.presses), "command": command}
    save(fitted.calibration, out / "sensor_file", {**source, **record})
    write_json(out / "metrics.json", record)
    _draw(judged, test, out / "held_out.png")
    _write(out / "lights.png", light_compass(fitted.calibration))
    print(f"sensor file: {out / 'sensor_file'}; pictures: {out / 'held_out.png'}, lights.png")


def _held_out_errors(judged: FittedCalibration, test: PressSet) -> dict[str, PictureErrors]:
    background = judged.calibration.background.astype(np.float32)
    balls = judged.ball_radii(test)
    simulated = {
        "background alone": [background] * len(test),
        "fit, circles as labelled": [*map(judged.simulate, judged.correct_labels(test), balls)],
        "fit, circles moved to the picture": [
            *map(judged.simulate, judged.fit_circles(test), balls)
        ],
    }
    return {
        name: mean_errors([*map(picture_errors, test.images, pictures, test.circles)])
        for name, pictures in simulated.items()
    }


def _table(errors: dict[str, PictureErrors], n: int) -> str:
    head = f"{f'{n} held-out presses, around the contact':<42}{'L1':>8}{'PSNR':>10}{'SSIM':>8}"
    rows = [
        f"{name:<42}{e.l1_near:>8.2f}{e.psnr_near:>7.1f} dB{e.ssim_near:>8.3f}"
        for name, e in errors.items()
    ]
    return "\n".join([head, *rows])


def _warnings(fitted: FittedCalibration) -> list[str]:
    """What the user should know about the presses."""
    calibration = fitted.calibration
    azimuths = ", ".join(f"{a:.0f}" for a in calibration.light_azimuths)
    lines = [
        f"lights (red, green, blue) stand at {azimuths} degrees; noise {calibration.noise:.2f} counts"
    ]
    if not fitted.varies_over_image:
        lines.append(
            "all presses lie in one place: how the light changes over the image is taken from the "
            "background alone; press all over the gel to have it fitted"
        )
    if fitted.ball_fitted:
        lines.append(
            f"ball_mm is empty: fitted, {fitted.ball_radius[0] * 1e3:.2f} mm; pictures tell it "
            "poorly, and every depth in mm is only as good: measure the ball"
        )
    return lines


def _record(
    fitted: FittedCalibration, presses: PressSet, errors: dict[str, PictureErrors], n_test: int
) -> dict[str, Any]:
    return {
        "presses": len(presses),
        "held_out_presses": n_test,
        "held_out": {name: asdict(e) for name, e in errors.items()},
        "ball_mm": sorted({round(float(r) * 1e3, 3) for r in fitted.ball_radius}),
        "ball_fitted": fitted.ball_fitted,
        "response_varies_over_image": fitted.varies_over_image,
        "label_offset_px": fitted.label_correction.offset.tolist(),
        "label_slope": fitted.label_correction.slope.tolist(),
    }


def _draw(judged: FittedCalibration, test: PressSet, path: Path) -> None:
    circles, balls = judged.fit_circles(test), judged.ball_radii(test)
    simulated = [*map(judged.simulate, circles, balls)]
    _write(path, side_by_side(list(test.images[:_MAX_SHOWN]), simulated[:_MAX_SHOWN]))


def _write(path: Path, picture: np.ndarray) -> None:
    cv2.imwrite(str(path), picture[..., ::-1])
