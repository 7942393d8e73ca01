"""How good a cost curve is: one number each for order, bumps, earliness and size.

A curve d (n,) is a distance to a goal per frame, small at the goal. "A perfect dense cost function
would be monotonically and smoothly decreasing for a successful trajectory" (MMWand, section V-E);
its claims are fewer peaks and an earlier drop. The definitions here follow from that, with three
cares that published reward metrics lack:

- a curve that does not change has no order: its correlations are None, never 0 or 1;
- ranks never come from `argsort`, which gives a constant curve a perfect score: ties share a rank;
- a bump counts only above the noise, eps = 3 sigma, sigma measured where nothing is touched.

Numbers with a unit of "curve" are in the unit of the curve handed in: for a normalised
curve, 1 is the usual way from start to goal.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Real
from scipy import signal, stats

Curve = Real[np.ndarray, "n"]

START_FRAMES = 5
"""Frames whose median is the start value d_0; the first frame alone carries its noise."""

EPS_FLOOR = 1e-3
"""Smallest eps (curve). A simulator's no-contact window can be exactly flat, sigma 0; then float
rounding (about 1e-5 of a normalised curve) must not count. A curve with a smaller range is
constant."""

MIN_NOISE_FRAMES = 10
"""Fewest frames before contact that give a sigma; with fewer the whole curve is used."""

DROP_FRACTION = 0.5
"""The drop that dates a curve (`t_drop_50`, `contact_lag`); fixed before any result was seen."""


@dataclass(frozen=True)
class CurveMetrics:
    """Everything measured on one curve; None means undefined, never zero.

    With v = -d and t the frame number; d_0 the median of the first 5 frames, d_T the last frame;
    net drop = d_0 - d_T. What divides by the net drop, or dates it, is None unless the net drop
    exceeds eps.

    Attributes:
        frames: n.
        sigma: noise (curve), 1.4826 MAD(diff d) / sqrt 2 over the no-contact window.
        eps: max(3 sigma, EPS_FLOOR) unless it was given (curve).
        noise_frames: frames in the window sigma comes from; equal to `frames` where fewer than
            MIN_NOISE_FRAMES precede the contact or none happens.
        start: d_0 (curve).
        end: d_T (curve).
        net_drop: d_0 - d_T (curve).
        drop_to_noise: net drop / max(sigma, EPS_FLOOR / 3).
        spearman: rank correlation of v and t, average ranks for ties; None for a constant curve.
        kendall_tau_b: tau-b of v and t; None for a constant curve.
        kendall_tolerant: tau-b of round(v / eps) and t, blind to order within the noise.
        pearson: linear correlation of v and t; None for a constant curve.
        peaks: local maxima, ends excluded, with prominence >= eps. Noise alone makes a few: white
            noise of standard deviation sigma about 4 in 100 frames.
        largest_rebound: max_t (d_t - min_{s<=t} d_s), the greatest climb after a low (curve).
        relative_rebound: largest_rebound / net drop.
        rebound_mass: sum max(0, diff d) / sum |diff d|, 0 monotone falling, 1 rising; None where
            nothing changes.
        violation_rate: share of steps that climb by more than eps.
        flat_fraction: share of steps that change by at most eps.
        variation_ratio: sum |diff d| / net drop; near 1 for a monotone curve.
        area: integral of d over the episode's duration taken as 1 (trapezoids); lower is earlier.
        t_drop_10: first frame at which 10 % of the net drop has fallen.
        t_drop_25: the same for 25 %.
        t_drop_50: the same for 50 %, the primary one.
        contact: first contact frame, as handed in.
        contact_lag: t_drop_50 - contact (frames); negative when the curve falls before contact.
    """

    frames: int
    sigma: float
    eps: float
    noise_frames: int
    start: float
    end: float
    net_drop: float
    drop_to_noise: float
    spearman: float | None
    kendall_tau_b: float | None
    kendall_tolerant: float | None
    pearson: float | None
    peaks: int
    largest_rebound: float
    relative_rebound: float | None
    rebound_mass: float | None
    violation_rate: float
    flat_fraction: float
    variation_ratio: float | None
    area: float
    t_drop_10: int | None
    t_drop_25: int | None
    t_drop_50: int | None
    contact: int | None
    contact_lag: int | None

    def as_dict(self) -> dict[str, Any]:
        """The fields by name, ready for JSON (None becomes null)."""
        return asdict(self)


def measure_curve(d: Curve, contact: int | None, eps: float | None = None) -> CurveMetrics:
    """Measure one curve.

    Args:
        d: distance to the goal per frame, at least 2 frames, finite.
        contact: first frame in contact, None if nothing is ever touched.
        eps: what counts as noise (curve). Default: 3 sigma of this curve. Give the same eps to
            several curves to compare their peaks on equal terms: a noisier curve excuses itself
            with a larger eps of its own.

    Raises:
        ValueError: fewer than 2 frames, a value that is not finite, a contact outside the curve.
    """
    d = _validated(d, contact)
    sigma, noise_frames = noise(d, contact)
    eps = max(3 * sigma, EPS_FLOOR) if eps is None else eps
    time = np.arange(len(d))
    not_constant = float(np.ptp(d)) > EPS_FLOOR
    start, end = start_value(d), float(d[-1])
    drop = start - end
    change = np.diff(d)
    total = float(np.abs(change).sum())
    rebound = largest_rebound(d)
    t_drop = time_of_drop(d, DROP_FRACTION, eps)
    return CurveMetrics(
        frames=len(d),
        sigma=sigma,
        eps=eps,
        noise_frames=noise_frames,
        start=start,
        end=end,
        net_drop=drop,
        drop_to_noise=drop / max(sigma, EPS_FLOOR / 3),
        spearman=spearman(-d, time) if not_constant else None,
        kendall_tau_b=kendall_tau_b(-d, time) if not_constant else None,
        kendall_tolerant=kendall_tau_b(np.round(-d / eps), time) if not_constant else None,
        pearson=pearson(-d, time) if not_constant else None,
        peaks=len(find_peaks(d, eps)),
        largest_rebound=rebound,
        relative_rebound=rebound / drop if drop > eps else None,
        rebound_mass=float(change[change > 0].sum()) / total if total > 0 else None,
        violation_rate=float(np.mean(change > eps)),
        flat_fraction=float(np.mean(np.abs(change) <= eps)),
        variation_ratio=total / drop if drop > eps else None,
        area=float(np.mean((d[1:] + d[:-1]) / 2)),
        t_drop_10=time_of_drop(d, 0.10, eps),
        t_drop_25=time_of_drop(d, 0.25, eps),
        t_drop_50=t_drop,
        contact=contact,
        contact_lag=None if t_drop is None or contact is None else t_drop - contact,
    )


def noise(d: Curve, contact: int | None) -> tuple[float, int]:
    """Noise sigma of a curve (curve) and the number of frames it was measured on.

    sigma = 1.4826 MAD(diff d) / sqrt 2 over the frames before contact: 1.4826 turns a median
    absolute deviation into a normal standard deviation, and the difference of two frames has
    sqrt 2 times the noise of one. A steady slope leaves MAD(diff d) unchanged.
    """
    window = d if contact is None or contact < MIN_NOISE_FRAMES else d[:contact]
    change = np.diff(window)
    mad = np.median(np.abs(change - np.median(change)))
    return float(1.4826 * mad / np.sqrt(2)), len(window)


def start_value(d: Curve) -> float:
    """d_0: the median of the first START_FRAMES frames."""
    return float(np.median(d[:START_FRAMES]))


def time_of_drop(d: Curve, fraction: float, eps: float) -> int | None:
    """First frame with d <= d_0 - fraction (d_0 - d_T); None if the net drop is at most eps."""
    start = start_value(d)
    drop = start - float(d[-1])
    if drop <= eps:
        return None
    return int(np.argmax(d <= start - fraction * drop))


def largest_rebound(d: Curve) -> float:
    """max_t (d_t - min_{s<=t} d_s): the greatest climb above the lowest value so far (curve)."""
    return float(np.max(d - np.minimum.accumulate(d)))


def find_peaks(d: Curve, eps: float) -> Int[np.ndarray, " peaks"]:
    """Frames of the local maxima whose prominence is at least eps.

    A run of equal values is one sample (reported at its middle frame), and the first and the last
    run are no peaks. The prominence of a peak is its height above the higher of two bases, each
    the lowest value between the peak and the nearest strictly higher value on that side, or the
    curve's end (the topographic definition, of scipy.signal.peak_prominences).
    """
    return signal.find_peaks(d, prominence=eps)[0]


def pearson(x: Curve, y: Curve) -> float | None:
    """Linear correlation of two sequences; None if either is constant."""
    return None if _constant(x, y) else float(np.asarray(stats.pearsonr(x, y))[0])


def spearman(x: Curve, y: Curve) -> float | None:
    """Correlation of the ranks, ties sharing the mean of theirs; None if either is constant."""
    return None if _constant(x, y) else float(np.asarray(stats.spearmanr(x, y))[0])


def kendall_tau_b(x: Curve, y: Curve) -> float | None:
    """Kendall's tau-b, corrected for ties in both; None if either is constant."""
    return (
        None
        if _constant(x, y)
        else float(np.asarray(stats.kendalltau(x, y, method="asymptotic"))[0])
    )


def _constant(x: Curve, y: Curve) -> bool:
    return bool(np.ptp(x) == 0 or np.ptp(y) == 0)


def _validated(d: Curve, contact: int | None) -> Float[np.ndarray, " n"]:
    if len(d) < 2:
        raise ValueError(f"a curve needs at least 2 frames, this one has {len(d)}")
    if not np.isfinite(d).all():
        raise ValueError("the curve has values that are not finite")
    if contact is not None and not 0 <= contact < len(d):
        raise ValueError(f"contact frame {contact} lies outside the curve's {len(d)} frames")
    return d.astype(np.float64)
