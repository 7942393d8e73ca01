"""Fit a sensor's light, gel and noise to ball presses, and write its sensor file.

PRESSES, as `touchgoal record-presses` makes it, holds background.png (the untouched sensor), images
of the presses, and presses.csv with the columns file and ball_mm (the ball's radius). Contact circles
are found, unless x_px, y_px and radius_px give them (the first pixel is 0, 0). Use two sizes of ball.
"""

import math
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro
from pydantic import Field

from touchgoal.runtime.option_types import Positive, Seed, checked_dataclass


@checked_dataclass
class Config:
    """Options of calibrate."""

    presses: Annotated[Path, tyro.conf.Positional]
    """Folder of the presses."""
    mm_per_pixel: Positive
    """Length on the gel that a pixel shows, mm."""
    sensor: str = "gelsight_mini"
    """Model of the sensor (`touchgoal list sensors`)."""
    ball_mm: Positive | None = None
    """Radius of the ball, mm, for presses without ball_mm in presses.csv."""
    check_lamps: bool = True
    """Refuse images with channels exchanged, mirrored or turned against the model's sensor file; switch
    it off for a sensor whose lamps are placed otherwise."""
    illumination_exponent: Positive | None = None
    """Power of the background's brightness by which the response varies over the image; default: the
    one with which depth shows the balls at their true radius (four fits, a few minutes)."""
    squares: bool = False
    """Let the response vary with the squared position, too, for light that falls off towards the borders;
    from 40 presses or more all over the gel."""
    out: Path | None = None
    """Folder of the run; the sensor file goes to its `sensor_file/`."""
    held_out: Annotated[float, Field(ge=0.1, le=0.5)] = 0.25
    """Share of the presses that is held out to measure the reported errors."""
    seed: Seed = 0
    """Random seed of the held-out choice."""


def main(config: Config) -> None:
    """Fit without the held-out presses and measure errors on them, then fit all."""
    from touchgoal.control.calibration import calibrate, report
    from touchgoal.control.calibration.press_set import read_presses, split
    from touchgoal.control.calibration.report import light_compass
    from touchgoal.control.tactile.image_guard import check_presses, check_untouched
    from touchgoal.control.tactile.sensor_calibration import save
    from touchgoal.control.tactile.sensor_models import find_model
    from touchgoal.runtime.errors import UserError
    from touchgoal.runtime.image_file import write_image
    from touchgoal.runtime.json_file import write_json
    from touchgoal.runtime.progress import progress_bar
    from touchgoal.runtime.provenance import provenance
    from touchgoal.runtime.run_folder import open_run

    model = find_model(config.sensor)
    pitch = config.mm_per_pixel * 1e-3
    presses = read_presses(config.presses, pitch, config.ball_mm or math.nan)
    if config.squares and len(presses) < calibrate.SQUARES_MINIMUM:
        raise UserError(
            f"--squares needs {calibrate.SQUARES_MINIMUM} presses, {config.presses} has {len(presses)}: add "
            "presses, or leave the option out"
        )
    if config.check_lamps:
        background, where = presses.background, config.presses
        check_untouched(background, model, f"{where}/background.png")
        check_presses(background, list(presses.images), model, f"the images in {where}")
    out = open_run(config.out, "calibrate", config)
    train, test = split(presses, round(config.held_out * len(presses)), config.seed)
    power = config.illumination_exponent
    if power is None:
        fits = len(calibrate.ILLUMINATION_EXPONENTS)
        with progress_bar("finding how the light varies", fits, "fit") as bar:
            power = calibrate.select_illumination_exponent(
                train, pitch, config.sensor, bar.update, config.squares
            )
    with progress_bar("fitting", 2 * calibrate.STEPS, "step") as bar:
        fit = partial(calibrate.fit, illumination_exponent=power, squares=config.squares)
        judged, fitted = (fit(each, pitch, config.sensor, bar.update) for each in (train, presses))
    errors = report.held_out_errors(judged, test)
    print(report.errors_table(errors, len(test)))
    report.require_better_than_background(errors)
    depth = calibrate.depth_errors(judged.calibration, test, judged.fit_circles(test))
    depths = report.median_by_ball(depth, test.ball_radius)
    print(report.depth_table(depths))
    for line in report.warnings(fitted, presses):
        print(line)
    metrics = report.calibration_metrics(fitted, presses, errors, depths, len(test))
    source = {"source": str(config.presses), **provenance()}
    save(fitted.calibration, out / "sensor_file", {**source, **metrics})
    write_json(out / "metrics.json", metrics)
    report.draw_held_out(judged, test, out / "held_out.png")
    write_image(out / "lights.png", light_compass(fitted.calibration))
    print(f"sensor file: {out / 'sensor_file'}; images: {out / 'held_out.png'}, lights.png")
