"""Where balls touch the gel, found in their pictures: no circle need be drawn by hand."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from touchgoal.runtime.errors import UserError

_BLUR = 2.0  # px
_SHARE = 0.3  # of the strongest change, at which the disc is taken to end
_FAINTEST = 8.0  # counts of change in the disc, or there is none
# The gel bulges around the contact: the visible disc is larger. On 46 real presses of two balls the
# fitted contacts are 0.7 of it.
CONTACT_SHARE = 0.7


def find_circle(
    image: UInt8[np.ndarray, "h w 3"], background: UInt8[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "3"]:
    """The contact of one ball: centre x, centre y and radius, px; the fit moves it further.

    Args:
        image: RGB picture of the press.
        background: the sensor untouched.

    Raises:
        UserError: nothing that changes stands out.
    """
    change = image.astype(np.float32) - background
    change -= np.median(change, (0, 1))
    strength = np.sqrt((cv2.GaussianBlur(change, (0, 0), _BLUR) ** 2).sum(2))
    strongest = float(np.percentile(strength, 99.7))
    if strongest < _FAINTEST:
        raise UserError(
            f"no contact is visible ({strongest:.0f} counts of change): drop the picture, press "
            "harder, or record background.png again"
        )
    disc = (strength > _SHARE * strongest).astype(np.uint8)
    disc = cv2.morphologyEx(disc, cv2.MORPH_OPEN, np.ones((7, 7), np.uint8))
    outlines, _ = cv2.findContours(disc, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not outlines:
        raise UserError("what changes is no disc: drop the picture, or give its circle")
    (x, y), radius = cv2.minEnclosingCircle(max(outlines, key=cv2.contourArea))
    return np.array([x, y, CONTACT_SHARE * radius])
