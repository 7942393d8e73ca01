"""What a calibration says of itself: errors on held-out presses, warnings, record and pictures."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from touchgoal.control.calibration.calibrate import FittedCalibration
from touchgoal.control.calibration.picture_errors import (
    PictureErrors,
    mean_errors,
    picture_errors,
)
from touchgoal.control.calibration.pictures import side_by_side
from touchgoal.control.calibration.press_set import PressSet

_MAX_SHOWN = 6  # held-out presses in the picture


def held_out_errors(judged: FittedCalibration, test: PressSet) -> dict[str, PictureErrors]:
    """Mean errors of the held-out pictures, by what predicts them."""
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


def errors_table(errors: dict[str, PictureErrors], n: int) -> str:
    """The errors as people read them."""
    head = f"{f'{n} held-out presses, around the contact':<42}{'L1':>8}{'PSNR':>10}{'SSIM':>8}"
    rows = [
        f"{name:<42}{e.l1_near:>8.2f}{e.psnr_near:>7.1f} dB{e.ssim_near:>8.3f}"
        for name, e in errors.items()
    ]
    return "\n".join([head, *rows])


def warnings(fitted: FittedCalibration) -> list[str]:
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


def record(
    fitted: FittedCalibration, presses: PressSet, errors: dict[str, PictureErrors], n_test: int
) -> dict[str, Any]:
    """What metrics.json holds, and the sensor file beside its values."""
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


def draw_held_out(judged: FittedCalibration, test: PressSet, path: Path) -> None:
    """Write held-out presses beside their simulation."""
    circles, balls = judged.fit_circles(test), judged.ball_radii(test)
    simulated = [*map(judged.simulate, circles, balls)]
    write_picture(path, side_by_side(list(test.images[:_MAX_SHOWN]), simulated[:_MAX_SHOWN]))


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Write an RGB picture."""
    cv2.imwrite(str(path), picture[..., ::-1])
