"""When a fingertip touches something, from its pictures alone."""

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from touchgoal.control.tactile.background import Background, local_change

THRESHOLD = 1.2  # counts; noise of 1 count has a strength of 0.3, at most 0.45
_SPARE = 2.0  # threshold of a noisy sensor per strength of its untouched frames
_RELEASE = 0.1  # of a contact's peak strength


class ContactDetector:
    """Tells frame by frame whether a sensor touches something, and lets its background follow.

    Contact begins when `strength` exceeds the threshold and ends when it falls below half of it,
    so that strength about the threshold does not make contact flicker; or below a tenth of the
    contact's peak, for during a long contact the light drifts on and the background cannot follow.

    Args:
        background: of the sensor; updated in place.
        threshold: counts.

    Attributes:
        touching: whether the last frame was in contact.
        strength: of the last frame, see `contact_strength`.
    """

    def __init__(self, background: Background, threshold: float | int = THRESHOLD) -> None:
        self.background, self._threshold = background, threshold
        self.touching, self.strength = False, 0.0
        self._peak = 0.0  # strength

    def update(self, frame: UInt8[np.ndarray, "h w 3"]) -> bool:
        """Judge the next frame."""
        self.strength = float(local_change(frame, self.background.image).max())
        self._peak = max(self._peak, self.strength) if self.touching else self.strength
        ends_at = np.clip(_RELEASE * self._peak, self._threshold / 2, self._threshold)
        self.touching = self.strength > float(ends_at if self.touching else self._threshold)
        if not self.touching:
            self.background.update(frame)
        return self.touching


def contact_strength(
    frames: UInt8[np.ndarray, "n h w 3"], background: UInt8[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, " n"]:
    """How much the strongest spot of each frame differs from the untouched gel, in counts.

    The largest `background.local_change`: what brighter or dimmer light, or a smooth change of it,
    explains does not count.

    Args:
        frames: RGB pictures of one fingertip sensor.
        background: the same sensor untouched.
    """
    return np.array([local_change(frame, background).max() for frame in frames], np.float32)


def threshold_for(
    untouched: UInt8[np.ndarray, "n h w 3"], background: UInt8[np.ndarray, "h w 3"]
) -> float:
    """Threshold (counts) for a sensor with the noise of these frames.

    That of a JPEG stream has a strength of about 1; see `THRESHOLD`, the least.
    """
    return max(THRESHOLD, _SPARE * float(contact_strength(untouched, background).max()))


def detect_contact(
    frames: UInt8[np.ndarray, "n h w 3"],
    background: UInt8[np.ndarray, "h w 3"],
    threshold: float | int = THRESHOLD,
) -> Bool[np.ndarray, " n"]:
    """Whether the sensor touches something, frame by frame: a `ContactDetector` over a recording.

    Args:
        frames: consecutive RGB pictures of one fingertip sensor.
        background: the same sensor untouched, such as the median of the first frames.
        threshold: counts.
    """
    detector = ContactDetector(Background(background[None]), threshold)
    return np.array([detector.update(frame) for frame in frames], bool)
