"""Errors of a simulated picture of a press against the measured one."""

from dataclasses import astuple, dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from touchgoal.control.calibration.press_fit import REGION


@dataclass(frozen=True)
class PictureErrors:
    """Errors of one picture; `near` is the region around the press, REGION contact radii wide.

    Attributes:
        l1_near: mean absolute error, counts.
        psnr_near: peak signal-to-noise ratio, dB.
        ssim_near: structural similarity, 1 at best.
        l1: mean absolute error of the whole picture, counts.
    """

    l1_near: float
    psnr_near: float
    ssim_near: float
    l1: float


def picture_errors(
    measured: UInt8[np.ndarray, "h w 3"],
    simulated: Float32[np.ndarray, "h w 3"],
    circle: Float[np.ndarray, " 3"],
) -> PictureErrors:
    """Return the errors of a simulated picture.

    Args:
        measured: RGB.
        simulated: RGB counts without noise; clipped to 0 and 255.
        circle: of the contact: centre x, centre y and radius, px.
    """
    x, y, radius = circle
    rows, columns = np.ogrid[: measured.shape[0], : measured.shape[1]]
    near = (columns - x) ** 2 + (rows - y) ** 2 < (REGION * radius) ** 2
    truth, picture = measured.astype(np.float32), simulated.clip(0, 255)
    error = np.abs(picture - truth)
    return PictureErrors(
        l1_near=float(error[near].mean()),
        psnr_near=float(10 * np.log10(255**2 / (error[near] ** 2).mean())),
        ssim_near=float(_structural_similarity(truth, picture)[near].mean()),
        l1=float(error.mean()),
    )


def mean_errors(errors: list[PictureErrors]) -> PictureErrors:
    """Return the mean of each error over several pictures."""
    return PictureErrors(*(float(v) for v in np.mean([astuple(e) for e in errors], 0)))


def _structural_similarity(
    a: Float32[np.ndarray, "h w 3"], b: Float32[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "h w 3"]:
    """Return SSIM (Wang et al. 2004): Gaussian window of 1.5 px, K1 = 0.01, K2 = 0.03."""

    def mean(image: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(image, (11, 11), 1.5)

    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    ma, mb = mean(a), mean(b)
    va, vb, cov = mean(a * a) - ma * ma, mean(b * b) - mb * mb, mean(a * b) - ma * mb
    return (2 * ma * mb + c1) * (2 * cov + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2))
