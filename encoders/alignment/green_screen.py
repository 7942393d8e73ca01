"""Green screen: cut out the foreground, and put another background behind it (MMWand, Figure 3).

The screen is recognised by its chromaticity, the share of each colour in a pixel, which shading and
shadows hardly change. Its own chromaticity is found in the image, so light of another tint needs
no setting.
"""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from touchgoal.control.arrays import Image
from touchgoal.control.sensors.clip import open_clip
from touchgoal.runtime.errors import UserError

Alpha = Float32[np.ndarray, "h w"]

_NEAR, _FAR = 0.035, 0.09  # distance from the screen's chromaticity: surely screen, surely not
_DARK = 12  # counts, sum of the colours, below which a pixel's chromaticity is unreliable
_GREEN = 0.45  # least share of green in a screen
_LEAST_GREEN = 0.05  # least share of an image that a screen takes up
_SMALLEST = 6  # px: specks below this area are noise
_SIZE = 224, 224  # rows and columns of a random background


Shares = Float32[np.ndarray, "2"]  # shares of red and green in a colour


def screen_chromaticity(image: Image) -> Shares | None:
    """Return the commonest colour among the green pixels; None where hardly anything is green."""
    shares, bright = _chromaticity(image)
    green = bright & (shares[..., 1] > _GREEN)
    if green.mean() < _LEAST_GREEN:
        return None
    bins = np.round(shares[green] * 100).astype(int)
    _, index, count = np.unique(bins, axis=0, return_inverse=True, return_counts=True)
    return np.median(shares[green][index.ravel() == count.argmax()], axis=0).astype(np.float32)


def foreground(image: Image, known: Shares | None = None) -> Alpha:
    """Return the foreground's share of each pixel, 0 to 1.

    UserError: no green screen is seen, nor is its colour known.

    Args:
        known: the screen's colour in other images, for one in which an object hides the screen.
    """
    screen = screen_chromaticity(image)
    screen = known if screen is None else screen
    if screen is None:
        raise UserError(f"no green screen: less than {_LEAST_GREEN:.0%} of the image is green")
    shares, bright = _chromaticity(image)
    away = np.linalg.norm(shares - screen, axis=2)
    alpha = np.clip((away - _NEAR) / (_FAR - _NEAR), 0, 1)
    alpha[~bright] = 1  # black is no screen: a screen in shadow is still green
    return _without_specks(alpha.astype(np.float32))


def replace_background(
    image: Image, background: UInt8[np.ndarray, "H W 3"], known: Shares | None = None
) -> Image:
    """Return the image's foreground on another background of any size, see `foreground`."""
    h, w = image.shape[:2]
    alpha = foreground(image, known)[..., None]
    behind = cv2.resize(background, (w, h), interpolation=cv2.INTER_AREA).astype(np.float32)
    mixed = alpha * _without_spill(image, alpha[..., 0]) + (1 - alpha) * behind
    return np.clip(mixed + 0.5, 0, 255).astype(np.uint8)


def random_background(rng: np.random.Generator) -> Image:
    """Draw a background: coloured clouds of several sizes, and a few edges as of furniture."""
    h, w = _SIZE
    image = np.full((h, w, 3), rng.uniform(30, 220, 3), np.float32)
    for cells in (2, 5, 12, 30):
        clouds = rng.normal(0, 90 / np.sqrt(cells), (cells, cells, 3)).astype(np.float32)
        image += cv2.resize(clouds, (w, h), interpolation=cv2.INTER_CUBIC)
    for _ in range(int(rng.integers(0, 6))):
        corners = rng.uniform(-0.2, 1.2, (4, 2)) * (w, h)
        hull = cv2.convexHull(corners.astype(np.int32))
        shade = np.array(image)
        cv2.fillConvexPoly(shade, hull, rng.uniform(20, 235, 3).tolist(), cv2.LINE_AA)
        image = cv2.addWeighted(image, 0.4, shade, 0.6, 0)
    return np.clip(image, 0, 255).astype(np.uint8)


def background_changer(backgrounds: str, seed: int) -> Callable[[Image], Image]:
    """Return a function that replaces an image's background by random ones.

    UserError: the folder has no images, or one that cannot be read.

    Args:
        backgrounds: "screen" leaves it as it is, "generated" draws them, or a folder of images.
    """
    if backgrounds == "screen":
        return lambda image: image
    rng = np.random.default_rng(seed)
    known: Shares | None = None
    images = None if backgrounds == "generated" else list(open_clip(Path(backgrounds)).frames())

    def change(image: Image) -> Image:
        nonlocal known
        screen = screen_chromaticity(image)
        known = known if screen is None else screen
        behind = images[rng.integers(len(images))] if images else random_background(rng)
        return replace_background(image, behind, known)

    return change


def _chromaticity(image: Image) -> tuple[Float32[np.ndarray, "h w 2"], Bool[np.ndarray, "h w"]]:
    """Return the shares of red and green, and where they can be trusted."""
    total = image.astype(np.float32).sum(2)
    return image[..., :2] / np.maximum(total, 1)[..., None], total > _DARK


def _without_specks(alpha: Alpha) -> Alpha:
    """Remove specks: a few pixels get the alpha of their surroundings."""
    for solid, fill in ((alpha > 0.5, 0.0), (alpha <= 0.5, 1.0)):
        _, parts, stats, _ = cv2.connectedComponentsWithStats(
            solid.astype(np.uint8), connectivity=8
        )
        small = stats[:, cv2.CC_STAT_AREA] < _SMALLEST
        small[0] = False
        alpha = np.where(np.isin(parts, np.flatnonzero(small)), np.float32(fill), alpha)
    return alpha


def _without_spill(image: Image, alpha: Alpha) -> Float32[np.ndarray, "h w 3"]:
    """Take the screen's green out of mixed pixels; solid ones keep their own green."""
    out = image.astype(np.float32)
    edge = cv2.dilate((alpha < 1).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    limit = (out[..., 0] + out[..., 2]) / 2
    out[..., 1] = np.where(
        edge, np.minimum(out[..., 1], np.maximum(limit, out[..., 1] * 0.3)), out[..., 1]
    )
    return out
