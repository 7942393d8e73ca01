"""Metrics of a cost curve d (n,), the distance to a goal at each frame.

"(curve)" marks a quantity in the unit of the curve. Undefined is None: a curve that does not change
has no order. Ties share a rank. A bump counts only above the noise, eps = 3 sigma, with sigma
measured before the contact.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, Real
from scipy import signal, stats

Curve = Real[np.ndarray, "n"]

START_FRAMES = 5  # frames whose median is the start value d_0

EPS_FLOOR = 1e-3
"""Smallest eps, and smallest range of a curve that is not constant (curve). Before the contact a
simulated curve can be exactly flat; float rounding (about 1e-5 of a normalised curve) must not count."""

_MIN_NOISE_FRAMES = 10  # before the contact that give sigma; with fewer the whole curve is used


@dataclass(frozen=True)
class CurveMetrics:
    """Metrics of one curve; None means undefined.

    With v = -d and t the frame number: d_0 is the median of the first 5 frames, d_T the last frame, and
    the net drop is d_0 - d_T. Times of drops are None unless the net drop exceeds eps.
    """

    sigma: float  # noise (curve), 1.4826 MAD(diff d) / sqrt 2 before the contact
    eps: float  # max(3 sigma, EPS_FLOOR) (curve)
    start: float  # d_0 (curve)
    end: float  # d_T (curve)
    spearman: float | None  # of v and t, average ranks for ties; None for a constant curve
    # local maxima, ends excluded, with prominence >= eps. White noise of standard deviation sigma
    # has about 4 in 100 frames
    peaks: int
    largest_rebound: float  # max_t (d_t - min_{s<=t} d_s), the largest rise after a minimum (curve)
    area: float  # integral of d (trapezoids), duration taken as 1; lower is earlier
    t_drop_10: int | None  # first frame at which 10 % of the net drop has fallen
    t_drop_25: int | None  # the same for 25 %
    t_drop_50: int | None  # the same for 50 %, the primary one
    contact_lag: (
        int | None
    )  # t_drop_50 - first contact (frames); negative if it falls before contact


def measure_curve(d: Curve, contact: int | None, eps: float | None = None) -> CurveMetrics:
    """Measure one curve.

    ValueError: fewer than 2 frames, a value that is not finite, a contact outside the curve.

    Args:
        d: distance to the goal per frame, at least 2 frames, finite.
        contact: first frame in contact; None without contact.
        eps: noise threshold (curve). Default: 3 sigma of this curve. Give the same eps to several
            curves to compare their peaks on equal terms.
    """
    if len(d) < 2:
        raise ValueError(f"a curve needs at least 2 frames, this one has {len(d)}")
    if not np.isfinite(d).all():
        raise ValueError("the curve has values that are not finite")
    if contact is not None and not 0 <= contact < len(d):
        raise ValueError(f"contact frame {contact} lies outside the curve's {len(d)} frames")
    d = d.astype(np.float64)
    sigma = noise(d, contact)
    eps = max(3 * sigma, EPS_FLOOR) if eps is None else eps
    time = np.arange(len(d))
    ordered = float(np.ptp(d)) > EPS_FLOOR
    start, end = float(np.median(d[:START_FRAMES])), float(d[-1])
    falls = [
        int(np.argmax(d <= start - share * (start - end))) if start - end > eps else None
        for share in (0.10, 0.25, 0.50)
    ]
    return CurveMetrics(
        sigma=sigma,
        eps=eps,
        start=start,
        end=end,
        spearman=spearman(-d, time) if ordered else None,
        peaks=len(find_peaks(d, eps)),
        largest_rebound=largest_rebound(d),
        area=float(np.mean((d[1:] + d[:-1]) / 2)),
        t_drop_10=falls[0],
        t_drop_25=falls[1],
        t_drop_50=falls[2],
        contact_lag=None if falls[2] is None or contact is None else falls[2] - contact,
    )


def noise(d: Curve, contact: int | None) -> float:
    """Return the noise sigma of a curve (curve).

    sigma = 1.4826 MAD(diff d) / sqrt 2 over the frames before contact: 1.4826 turns a median
    absolute deviation into a normal standard deviation, and the difference of two frames has
    sqrt 2 times the noise of one. A steady slope leaves MAD(diff d) unchanged.
    """
    window = d if contact is None or contact < _MIN_NOISE_FRAMES else d[:contact]
    change = np.diff(window)
    mad = np.median(np.abs(change - np.median(change)))
    return float(1.4826 * mad / np.sqrt(2))


def largest_rebound(d: Curve) -> float:
    """Return max_t (d_t - min_{s<=t} d_s), the largest rise after a minimum (curve)."""
    return float(np.max(d - np.minimum.accumulate(d)))


def find_peaks(d: Curve, eps: float) -> Int[np.ndarray, " peaks"]:
    """Return the frames of the local maxima whose prominence is at least eps.

    A run of equal values is one sample (reported at its middle frame), and the first and the last
    run are no peaks. Prominence is that of scipy.signal.peak_prominences.
    """
    return signal.find_peaks(d, prominence=eps)[0]


def auc(
    successes: Sequence[float] | Real[np.ndarray, " a"],
    failures: Sequence[float] | Real[np.ndarray, " b"],
) -> float:
    """Return the share of pairs in which the failure costs more than the success; ties count half."""
    low, high = np.asarray(successes)[:, None], np.asarray(failures)
    return float(np.mean((high > low) + 0.5 * (high == low)))


def spearman(x: Curve, y: Curve) -> float | None:
    """Return the correlation of ranks, ties sharing their mean; None if either is constant."""
    return float(np.asarray(stats.spearmanr(x, y))[0]) if np.ptp(x) and np.ptp(y) else None
