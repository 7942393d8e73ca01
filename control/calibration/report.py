"""Report of a calibration: held-out errors, warnings, record and pictures."""

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
from touchgoal.control.calibration.press_fit import (
    BLUR_PYRAMID,
    BLUR_SCALES,
    NARROWEST,
    WIDEST,
)
from touchgoal.control.calibration.press_set import PressSet
from touchgoal.runtime.errors import UserError

# Errors (L1) above this share of the background's own mean that the fit explains nothing.
_USELESS = 0.9
_AT_LIMIT = 0.2  # share of circles at a search limit that is worth a warning
_MAX_SHOWN = 6  # held-out presses in the picture


def held_out_errors(judged: FittedCalibration, test: PressSet) -> dict[str, PictureErrors]:
    """Return mean errors of the held-out pictures by the predictor."""
    given = "labelled" if test.labelled else "found"
    background = judged.calibration.background.astype(np.float32)
    balls = judged.ball_radii(test)
    simulated = {
        "background alone": [background] * len(test),
        f"fit, circles as {given}": [*map(judged.simulate, judged.correct_labels(test), balls)],
        "fit, circles moved to the picture": [
            *map(judged.simulate, judged.fit_circles(test), balls)
        ],
    }
    return {
        name: mean_errors([*map(picture_errors, test.images, pictures, test.circles)])
        for name, pictures in simulated.items()
    }


def errors_table(errors: dict[str, PictureErrors], n: int) -> str:
    """Format the held-out errors."""
    head = f"{f'{n} held-out presses, around the contact':<42}{'L1':>8}{'PSNR':>10}{'SSIM':>8}"
    rows = [
        f"{name:<42}{e.l1_near:>8.2f}{e.psnr_near:>7.1f} dB{e.ssim_near:>8.3f}"
        for name, e in errors.items()
    ]
    return "\n".join([head, *rows])


def depth_table(depths: dict[str, dict[str, float]]) -> str:
    """Format the depth of held-out presses."""
    return "\n".join(
        f"depth: a ball of {size} mm reads {d['radius_mm']:.2f} mm (median of {d['presses']:.0f} "
        "held-out "
        f"presses), {d['residual_um']:.0f} um from a sphere, its peak {d['peak_offset_mm']:.2f} "
        "mm off"
        for size, d in depths.items()
    )


def refuse_useless(errors: dict[str, PictureErrors]) -> None:
    """Raise UserError unless the fit beats the background on held-out pictures."""
    alone = errors["background alone"].l1_near
    best = min(e.l1_near for name, e in errors.items() if name != "background alone")
    if best > _USELESS * alone:
        raise UserError(
            f"the fit predicts held-out presses no better ({best:.1f} counts) than the background "
            f"alone ({alone:.1f}): check that background.png is of this sensor and that the "
            "circles lie "
            "on the contacts, or leave them out of presses.csv to have them found"
        )


def at_limits(fitted: FittedCalibration, presses: PressSet) -> list[str]:
    """Return warnings about parameters at a limit of their search."""
    calibration, circles = fitted.calibration, fitted.circles
    moved = np.abs(circles[:, :2] - presses.circles[:, :2]).max(1) > 0.98 * presses.circles[:, 2]
    widest = WIDEST * fitted.ball_radius / calibration.pixel_pitch
    most = np.minimum(1.5 * presses.circles[:, 2], widest)
    size = (circles[:, 2] > 0.99 * most) | (circles[:, 2] <= NARROWEST)
    lines = []
    if (stuck := moved | size).mean() > _AT_LIMIT:
        names = ", ".join(np.array(presses.files)[stuck][:4])
        lines.append(
            f"{stuck.sum()} of {len(stuck)} circles stand at their search limit ({names}): check "
            "ball_mm, "
            "the scale, and that one ball alone touches"
        )
    narrowest, softest = (BLUR_SCALES[i] * BLUR_PYRAMID[0] for i in (0, -1))
    if calibration.blur_sigmas[0] >= softest or calibration.blur_sigmas[0] <= narrowest:
        lines.append(
            "the gel's bulge stands at its search limit: depths beside contacts are uncertain"
        )
    return lines


def warnings(fitted: FittedCalibration) -> list[str]:
    """Return lines on the lights and on what the presses leave open."""
    calibration = fitted.calibration
    azimuths = ", ".join(f"{a:.0f}" for a in calibration.light_azimuths)
    lines = [
        f"lights (red, green, blue) stand at {azimuths} degrees; noise {calibration.noise:.2f} "
        "counts"
    ]
    if not fitted.varies_over_image:
        lines.append(
            "all presses lie in one place: how the light changes over the image is taken from the "
            "background alone; press all over the gel to have it fitted"
        )
    if fitted.ball_fitted:
        lines.append(
            f"the ball's radius is fitted, {fitted.ball_radius[0] * 1e3:.2f} mm; pictures tell it "
            "poorly, and every depth in mm is only as good: measure the ball"
        )
    return lines


def record(
    fitted: FittedCalibration,
    presses: PressSet,
    errors: dict[str, PictureErrors],
    depths: dict[str, dict[str, float]],
    n_test: int,
) -> dict[str, Any]:
    """Return metrics.json, which is also the provenance in the sensor file."""
    return {
        "presses": len(presses),
        "held_out_presses": n_test,
        "held_out": {name: asdict(e) for name, e in errors.items()},
        "held_out_depth": depths,
        "illumination_exponent": fitted.calibration.illumination_exponent,
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
