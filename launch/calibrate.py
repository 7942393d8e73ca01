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

from touchgoal.control.calibration.calibrate import STEPS, Calibration, fit
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

_SHOWN = 6  # held-out presses in the picture


@dataclass(frozen=True)
class Config:
    """Options of calibrate."""

    presses: Annotated[Path, tyro.conf.Positional]
    """Folder of presses."""
    scale: float
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
    if not config.scale > 0:
        raise UserError("--scale must be positive: millimetres of gel per pixel")
    if not 0.1 <= config.held_out <= 0.5:
        raise UserError("--held-out must lie between 0.1 and 0.5")
    pitch = config.scale * 1e-3
    presses = read_presses(config.presses, pitch)
    out = open_run(config.out, "calibrate", config)
    train, test = split(presses, round(config.held_out * len(presses)), config.seed)
    with tqdm(total=2 * STEPS, desc="fit") as bar:
        judged = fit(train, pitch, config.sensor, bar.update)
        calibration = fit(presses, pitch, config.sensor, bar.update)
    errors = _held_out_errors(judged, test)
    print(_table(errors, len(test)))
    for line in _remarks(calibration):
        print(line)
    record = _record(calibration, presses, errors, len(test))
    command = shlex.join(["touchgoal", *sys.argv[1:]])
    source = {"source": config.source or str(config.presses), "command": command}
    save(calibration.photometry, out / "sensor_file", {**source, **record})
    write_json(out / "metrics.json", record)
    _draw(judged, test, out / "held_out.png")
    _write(out / "lights.png", light_compass(calibration.photometry))
    print(f"sensor file: {out / 'sensor_file'}; pictures: {out / 'held_out.png'}, lights.png")


def _held_out_errors(judged: Calibration, test: PressSet) -> dict[str, PictureErrors]:
    background = judged.photometry.background.astype(np.float32)
    balls = judged.balls(test)
    simulated = {
        "background alone": [background] * len(test),
        "fit, circles as labelled": [*map(judged.simulate, judged.place(test), balls)],
        "fit, circles moved to the picture": [*map(judged.simulate, judged.register(test), balls)],
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


def _remarks(calibration: Calibration) -> list[str]:
    """What the user should know about the presses."""
    photometry = calibration.photometry
    azimuths = ", ".join(f"{a:.0f}" for a in photometry.light_azimuths)
    lines = [
        f"lights (red, green, blue) stand at {azimuths} degrees; noise {photometry.noise:.2f} counts"
    ]
    if not calibration.position:
        lines.append(
            "all presses lie in one place: how the light changes over the image is taken from the "
            "background alone; press all over the gel to have it fitted"
        )
    if calibration.ball_fitted:
        lines.append(
            f"ball_mm is empty: fitted, {calibration.ball_radius[0] * 1e3:.2f} mm; pictures tell it "
            "poorly, and every depth in mm is only as good: measure the ball"
        )
    return lines


def _record(
    calibration: Calibration, presses: PressSet, errors: dict[str, PictureErrors], n_test: int
) -> dict[str, Any]:
    return {
        "presses": len(presses),
        "held_out_presses": n_test,
        "held_out": {name: asdict(e) for name, e in errors.items()},
        "ball_mm": sorted({round(float(r) * 1e3, 3) for r in calibration.ball_radius}),
        "ball_fitted": calibration.ball_fitted,
        "response_varies_over_image": calibration.position,
        "label_offset_px": calibration.labels.offset.tolist(),
        "label_slope": calibration.labels.slope.tolist(),
    }


def _draw(judged: Calibration, test: PressSet, path: Path) -> None:
    circles, balls = judged.register(test), judged.balls(test)
    simulated = [*map(judged.simulate, circles, balls)]
    _write(path, side_by_side(list(test.images[:_SHOWN]), simulated[:_SHOWN]))


def _write(path: Path, picture: np.ndarray) -> None:
    cv2.imwrite(str(path), picture[..., ::-1])
