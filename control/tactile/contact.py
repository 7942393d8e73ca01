"""Contact of a fingertip, from its images alone."""

import numpy as np
from jaxtyping import Float32

from touchgoal.control.arrays import Image, Images
from touchgoal.control.tactile.background import Background, local_change
from touchgoal.control.tactile.light_gain import remove_gain

THRESHOLD = 1.2  # counts; noise of 1 count has a strength of 0.3, at most 0.45
# Threshold of a noisy sensor per usual strength of its untouched frames. On 409 clips of a real
# Mini (PhysiCLeAR) 2.5 finds every touch; at 2 and below, untouched frames count as touches.
_SPARE = 2.5
# Threshold (counts) above which light touches are missed: JPEG of quality 50 has 7 to 9, of 70 at most
# 5.4, 60 clips of a real Mini (PhysiCLeAR) 2.3 to 6.7.
_COARSE = 7.0
# Counts: a threshold above it comes of a touch in the first frames, not of compression.
_NO_NOISE = 30.0
_LEARNING_FRAMES = 10  # 0.4 s of a 25 Hz sensor
_FEWEST_FRAMES = 3  # of these that differ
_LEARNING_QUANTILE = 0.3
_OVER_NOISE = 1.8  # multiple of the usual noise below which any contact ends
_LEARNING_THRESHOLD = 5.0  # counts; the strongest compression noise measured had a strength of 2.5
_MOST_NOISE = 10.0  # counts, four times that; a firm grasp changes all of a gel, as noise does
# Strength of a change per its median over the image, above which it is no noise: Gaussian noise
# reaches 6, presses of balls on a real Mini 16 to 25.
_NOISE_PEAK = 8.0
_RELEASE = 0.1  # share of a contact's peak strength at which it ends


class ContactDetector:
    """Contact detector that updates its background, in place, while nothing touches.

    Contact begins when `strength` (see `contact_strength`) exceeds the threshold, counts. It ends
    below half of it, so that it does not flicker, or below a tenth of the contact's peak, because
    the light drifts on during a long one. Without a threshold it is learned from the noise of the
    first 10 frames, during which only a strong contact counts: 5 counts, or eight times the median
    over the image, because noise is everywhere; 10 are enough.
    """

    def __init__(self, background: Background, threshold: float | int | None = None) -> None:
        self.background = background
        self.threshold = _LEARNING_THRESHOLD if threshold is None else float(threshold)
        self._untouched: list[float] | None = [] if threshold is None else None  # strengths
        self._seen = 0  # untouched frames while learning, repeats included
        self._noise = 0.0  # usual strength of untouched frames, estimated so far
        self.touching, self.strength = False, 0.0
        self._peak = 0.0  # strength
        self._latest = np.rint(background.steady).astype(np.uint8)  # frame learned from

    def update(self, frame: Image) -> bool:
        """Process the next frame and return whether it is in contact."""
        rest = self.background.steady
        change = local_change(remove_gain(frame, rest), rest)
        self.strength = float(change.max())
        if self._untouched is not None:
            noise = min(_NOISE_PEAK * float(np.median(change)), _MOST_NOISE)
            self.threshold = max(_LEARNING_THRESHOLD, noise)
        self._peak = max(self._peak, self.strength) if self.touching else self.strength
        least = max(self.threshold / 2, _OVER_NOISE * self._noise)
        ends_at = np.clip(_RELEASE * self._peak, least, self.threshold)
        self.touching = self.strength > float(ends_at if self.touching else self.threshold)
        if not self.touching:
            self._learn(frame)
            self.background.update(frame)
        return self.touching

    def _learn(self, frame: Image) -> None:
        """Estimate the sensor's noise from its first untouched frames, of which repeats show none."""
        if self._untouched is None:
            return
        self._seen += 1
        if not np.array_equal(frame, self._latest):
            self._untouched.append(self.strength)
        self._latest = frame.copy()
        if self._seen >= _LEARNING_FRAMES and len(self._untouched) >= _FEWEST_FRAMES:
            # Not the mean: a contact may begin, too weak to detect yet.
            self._noise = float(np.quantile(self._untouched, _LEARNING_QUANTILE))
            self.threshold = max(THRESHOLD, _SPARE * self._noise)
            self._untouched = None


def contact_strength(frames: Images, background: Image) -> Float32[np.ndarray, " n"]:
    """Return the largest `local_change` (counts) of each RGB frame from the same sensor untouched."""
    changes = (local_change(remove_gain(frame, background), background) for frame in frames)
    return np.array([change.max() for change in changes], np.float32)


def threshold_for(untouched: Images, background: Image) -> float:
    """Return the contact threshold (counts) for a sensor with the noise of these frames.

    Compressed streams have a strength of 1 to 2. Fewer than half of the frames may be in contact. A
    single one shows no noise: 5 counts.
    """
    if len(untouched) == 1:
        return _LEARNING_THRESHOLD
    return max(THRESHOLD, _SPARE * float(np.median(contact_strength(untouched, background))))


def coarse(threshold: float) -> str:
    """Return what is wrong with images that need so high a contact threshold; "" if nothing."""
    if not _COARSE < threshold <= _NO_NOISE:
        return ""
    return (
        f"its images are so compressed or noisy that contact needs {threshold:.1f} counts, above "
        f"{_COARSE:g} light touches are missed: send or store them at JPEG quality 90 or without loss"
    )
