"""Report of a calibration: held-out errors, warnings, record and images."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from touchgoal.control.arrays import AnyImage, Circle, Counts, Image
from touchgoal.control.calibration import press_fit
from touchgoal.control.calibration.ball import DepthErrors, squared_distance
from touchgoal.control.calibration.calibrate import FittedCalibration
from touchgoal.control.calibration.press_set import PressSet
from touchgoal.control.tactile.sensor_calibration import SensorCalibration
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import write_image

_USELESS = 0.9  # L1 errors above this share of the background's: the fit explains nothing
_AT_LIMIT = 0.2  # share of circles at a search limit that is worth a warning
_MAX_SHOWN = 6  # held-out presses in the image
_CONTRAST = 4  # factor on the difference in its column
_PAIRS_PER_ROW = 2
_LIGHTS = {"R": (213, 94, 0), "G": (0, 158, 115), "B": (0, 114, 178)}  # Okabe and Ito
_GREY, _INK, _PAPER = (150, 150, 150), (40, 40, 40), 255


ImageErrors = dict[str, float]
"""Mean absolute error of the whole image (`l1`, counts); and within REGION contact radii, where the
press is: `l1_near`, peak signal-to-noise ratio (`psnr_near`, dB), SSIM (`ssim_near`, 1 at best)."""


def image_errors(measured: Image, simulated: Counts, circle: Circle) -> ImageErrors:
    """Return the errors of an image of a press, simulated without noise and not yet clipped."""
    near = squared_distance(measured.shape, circle) < (press_fit.REGION * circle[2]) ** 2
    truth, image = measured.astype(np.float32), simulated.clip(0, 255)
    error, similarity = np.abs(image - truth), cv2.quality.QualitySSIM.create(truth)
    similarity.compute(image)
    return {
        "l1_near": float(error[near].mean()),
        "psnr_near": float(10 * np.log10(255**2 / (error[near] ** 2).mean())),
        "ssim_near": float(np.asarray(similarity.getQualityMap())[near].mean()),
        "l1": float(error.mean()),
    }


def mean_errors(errors: list[ImageErrors]) -> ImageErrors:
    """Return the mean of each error over several images."""
    return {name: float(np.mean([each[name] for each in errors])) for name in errors[0]}


def held_out_errors(judged: FittedCalibration, test: PressSet) -> dict[str, ImageErrors]:
    """Return mean errors of the held-out images by the predictor."""
    given = "labelled" if test.labelled else "found"
    background = judged.calibration.background.astype(np.float32)
    simulated = {
        "background alone": [background] * len(test),
        f"fit, circles as {given}": judged.simulate(test, judged.correct_labels(test)),
        "fit, circles moved to the picture": judged.simulate(test, judged.fit_circles(test)),
    }
    return {
        name: mean_errors([*map(image_errors, test.images, images, test.circles)])
        for name, images in simulated.items()
    }


def errors_table(errors: dict[str, ImageErrors], n: int) -> str:
    """Format the held-out errors."""
    lines = [f"{f'{n} held-out presses, around the contact':<42}{'L1':>8}{'PSNR':>10}{'SSIM':>8}"]
    for name, e in errors.items():
        figures = f"{e['l1_near']:>8.2f}{e['psnr_near']:>7.1f} dB{e['ssim_near']:>8.3f}"
        lines.append(f"{name:<42}{figures}")
    return "\n".join(lines)


def median_by_ball(
    errors: list[DepthErrors], balls: Float[np.ndarray, " n"]
) -> dict[str, dict[str, float]]:
    """Return medians over the presses of each ball, by its radius in mm."""
    sizes = np.round(balls * 1e3, 3)
    table = {}
    for size in np.unique(sizes):
        own = [list(asdict(e).values()) for e, s in zip(errors, sizes, strict=True) if s == size]
        radius, residual, offset = np.median(own, 0)
        table[f"{size:g}"] = {
            "presses": len(own),
            "radius_mm": float(radius * size),
            "residual_um": float(residual * 1e6),
            "peak_offset_mm": float(offset * 1e3),
        }
    return table


def depth_table(depths: dict[str, dict[str, float]]) -> str:
    """Format the depth of held-out presses."""
    return "\n".join(
        f"depth: a ball of {size} mm reads {d['radius_mm']:.2f} mm (median of {d['presses']:.0f} "
        f"held-out presses), {d['residual_um']:.0f} um from a sphere, its peak "
        f"{d['peak_offset_mm']:.2f} mm off"
        for size, d in depths.items()
    )


def require_better_than_background(errors: dict[str, ImageErrors]) -> None:
    """Raise UserError unless the fit beats the background on held-out images."""
    alone = errors["background alone"]["l1_near"]
    best = min(e["l1_near"] for name, e in errors.items() if name != "background alone")
    if best > _USELESS * alone:
        raise UserError(
            f"the fit predicts held-out presses no better ({best:.1f} counts) than the background "
            f"alone ({alone:.1f}): check that background.png is of this sensor and that the circles "
            "lie on the contacts, or leave them out of presses.csv to have them found"
        )


def warnings(fitted: FittedCalibration, presses: PressSet) -> list[str]:
    """Return lines on the lights, on what the presses leave open, and on search limits."""
    calibration, circles = fitted.calibration, fitted.circles
    azimuths = ", ".join(f"{a:.0f}" for a in calibration.light_azimuths)
    lines = [
        f"lights (red, green, blue) stand at {azimuths} degrees; noise {calibration.noise:.2f} counts"
    ]
    if not fitted.varies_over_image:
        lines.append(
            "all presses lie in one place: how the light changes over the image is taken from the "
            "background alone; press all over the gel to have it fitted"
        )
    moved = np.abs(circles[:, :2] - presses.circles[:, :2]).max(1) > 0.98 * presses.circles[:, 2]
    widest = press_fit.WIDEST * presses.ball_radius / calibration.pixel_pitch
    most = np.minimum(1.5 * presses.circles[:, 2], widest)
    size = (circles[:, 2] > 0.99 * most) | (circles[:, 2] <= press_fit.NARROWEST)
    if (stuck := moved | size).mean() > _AT_LIMIT:
        names = ", ".join(np.array(presses.files)[stuck][:4])
        lines.append(
            f"{stuck.sum()} of {len(stuck)} circles stand at their search limit ({names}): check "
            "ball_mm, the scale, and that one ball alone touches"
        )
    narrowest, softest = (press_fit.BLUR_SCALES[i] * press_fit.BLUR_PYRAMID[0] for i in (0, -1))
    if calibration.blur_sigmas[0] >= softest or calibration.blur_sigmas[0] <= narrowest:
        lines.append(
            "the gel's bulge stands at its search limit: depths beside contacts are uncertain"
        )
    return lines


def calibration_metrics(
    fitted: FittedCalibration,
    presses: PressSet,
    errors: dict[str, ImageErrors],
    depths: dict[str, dict[str, float]],
    n_test: int,
) -> dict[str, Any]:
    """Return metrics.json, which is also the provenance in the sensor file."""
    return {
        "presses": len(presses),
        "held_out_presses": n_test,
        "held_out": errors,
        "held_out_depth": depths,
        "illumination_exponent": fitted.calibration.illumination_exponent,
        "ball_mm": sorted({round(float(r) * 1e3, 3) for r in presses.ball_radius}),
        "response_varies_over_image": fitted.varies_over_image,
        "label_offset_px": fitted.label_offset.tolist(),
        "label_slope": fitted.label_slope.tolist(),
    }


def draw_held_out(judged: FittedCalibration, test: PressSet, path: Path) -> None:
    """Write held-out presses beside their simulation."""
    shown = test.take(np.arange(min(_MAX_SHOWN, len(test))))
    simulated = judged.simulate(shown, judged.fit_circles(shown))
    write_image(path, side_by_side(list(shown.images), simulated))


def side_by_side(
    measured: Sequence[AnyImage], simulated: Sequence[Counts]
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw measured | simulated | difference times 4 about grey, RGB, under a heading."""
    tiles = []
    for real, made in zip(measured, simulated, strict=True):
        image = made.clip(0, 255)
        difference = (128 + _CONTRAST * (real - image)).clip(0, 255)
        tiles.append(np.hstack([real, image, difference]).astype(np.uint8))
    tiles += [np.full_like(tiles[0], _PAPER)] * (-len(tiles) % _PAIRS_PER_ROW)
    rows = [np.hstack(tiles[i : i + _PAIRS_PER_ROW]) for i in range(0, len(tiles), _PAIRS_PER_ROW)]
    width = tiles[0].shape[1] // 3
    texts = ("measured", "simulated", f"difference x{_CONTRAST}") * _PAIRS_PER_ROW
    return np.vstack([heading(texts, width), *rows])


def heading(texts: Sequence[str], width: int) -> UInt8[np.ndarray, "24 W 3"]:
    """Draw the names of columns of images of that width (px)."""
    image = np.full((24, len(texts) * width, 3), _PAPER, np.uint8)
    for i, text in enumerate(texts):
        _write(image, text, (i + 0.5) * width, 12, _INK)
    return image


def light_compass(calibration: SensorCalibration) -> UInt8[np.ndarray, "320 320 3"]:
    """Draw where in the image the lights stand, by channel: x to the right, y down.

    A line's length is the channel's response to slope in the middle of the image, relative to the
    strongest.
    """
    image = np.full((320, 320, 3), _PAPER, np.uint8)
    centre, reach = 160, 115.2  # px
    cv2.circle(image, (centre, centre), round(reach), _GREY, 1, cv2.LINE_AA)
    for text, dx, dy in (("0", 1, 0), ("90", 0, 1), ("180", -1, 0), ("-90", 0, -1)):
        _write(image, text, centre + dx * 1.18 * reach, centre + dy * 1.18 * reach, _GREY)
    strength = np.linalg.norm(calibration.response[:, :2, 0], axis=1)
    lengths = (reach * strength / strength.max()).tolist()
    for (name, colour), azimuth, length in zip(
        _LIGHTS.items(), calibration.light_azimuths, lengths, strict=True
    ):
        dx, dy = math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))
        tip = round(centre + length * dx), round(centre + length * dy)
        cv2.arrowedLine(image, (centre, centre), tip, colour, 3, cv2.LINE_AA, tipLength=0.08)
        beside = centre + 0.62 * length * dx - 28 * dy, centre + 0.62 * length * dy + 28 * dx
        _write(image, f"{name} {azimuth:.0f}", *beside, colour)
    return image


def _write(image: Image, text: str, x: float, y: float, colour: tuple[int, int, int]) -> None:
    """Write text centred at (x, y)."""
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
    at = round(x - width / 2), round(y + height / 2)
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)
