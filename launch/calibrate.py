"""Fit a sensor's light, gel and noise to ball presses, and write its sensor file.

PRESSES holds background.png (the untouched sensor), the pictures of the presses, and presses.csv
with the columns file, x_px, y_px, radius_px (centre and radius of the circle in which ball and gel
touch; the first pixel is 0, 0) and ball_mm (the ball's radius; empty if not known).
"""

from pathlib import Path
from typing import Annotated

import tyro
from pydantic import Field

from touchgoal.control.errors import UserError
from touchgoal.control.option_types import Positive, Seed, checked_dataclass


@checked_dataclass
class Config:
    """Options of calibrate."""

    presses: Annotated[Path, tyro.conf.Positional]
    """Folder of the presses."""
    mm_per_pixel: Positive
    """Length on the gel that a pixel shows, mm."""
    sensor: str = "gelsight_mini"
    """Model of the sensor (`touchgoal list sensors`)."""
    out: Path | None = None
    """Folder of the run; the sensor file goes to its `sensor_file/`."""
    held_out: Annotated[float, Field(ge=0.1, le=0.5)] = 0.25
    """Share of the presses that are not fitted, on which the reported errors are measured."""
    seed: Seed = 0
    """Random seed of the choice of those presses."""
    source: str = ""
    """Where the presses come from, for the record; default: their folder."""


def main(config: Config) -> None:
    """Fit without the held-out presses and judge on them, then fit all; UserError for bad input."""
    from touchgoal.control.calibration import report
    from touchgoal.control.calibration.calibrate import STEPS, fit
    from touchgoal.control.calibration.pictures import light_compass
    from touchgoal.control.calibration.press_set import read_presses, split
    from touchgoal.control.progress import Progress
    from touchgoal.control.provenance import provenance
    from touchgoal.control.tactile.sensor_calibration import save
    from touchgoal.control.tactile.sensor_models import SENSORS
    from touchgoal.launch.run_folder import open_run, write_json

    if config.sensor not in SENSORS:
        raise UserError(f"unknown sensor {config.sensor!r}; choose from: {', '.join(SENSORS)}")
    pitch = config.mm_per_pixel * 1e-3
    presses = read_presses(config.presses, pitch)
    out = open_run(config.out, "calibrate", config)
    train, test = split(presses, round(config.held_out * len(presses)), config.seed)
    with Progress("fitting", 2 * STEPS, "step") as bar:
        judged = fit(train, pitch, config.sensor, bar.update)
        fitted = fit(presses, pitch, config.sensor, bar.update)
    errors = report.held_out_errors(judged, test)
    print(report.errors_table(errors, len(test)))
    for line in report.warnings(fitted):
        print(line)
    record = report.record(fitted, presses, errors, len(test))
    source = {"source": config.source or str(config.presses), **provenance()}
    save(fitted.calibration, out / "sensor_file", {**source, **record})
    write_json(out / "metrics.json", record)
    report.draw_held_out(judged, test, out / "held_out.png")
    report.write_picture(out / "lights.png", light_compass(fitted.calibration))
    print(f"sensor file: {out / 'sensor_file'}; pictures: {out / 'held_out.png'}, lights.png")
