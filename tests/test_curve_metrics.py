"""Curve metrics against hand-computed values and the known traps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchgoal.rewards.metrics import (
    EPS_FLOOR,
    find_peaks,
    kendall_tau_b,
    largest_rebound,
    measure_curve,
    noise,
    spearman,
)

# Small integers make ties and plateaus common; halves keep every sum exact.
CURVES = st.lists(st.integers(-6, 6), min_size=3, max_size=24).map(
    lambda values: np.array(values) / 2
)
STEP = np.where(np.arange(100) < 50, 1.0, 0.0)


def test_correlations_by_hand() -> None:
    x, y = np.array([1.0, 2.0, 2.0, 3.0]), np.array([1.0, 3.0, 2.0, 4.0])
    # Ranks centred: (-1.5, 0, 0, 1.5) and (-1.5, .5, -.5, 1.5): 4.5 / sqrt(4.5 * 5).
    assert spearman(x, y) == pytest.approx(0.9**0.5)
    # 5 concordant pairs, 1 tie in x of 6 pairs: 5 / sqrt(5 * 6).
    assert kendall_tau_b(x, y) == pytest.approx(5 / 30**0.5)


def test_peaks_by_hand() -> None:
    """A plateau is one peak, at its middle; ends are none; prominence is over the higher base."""
    d = np.array([3.0, 1.0, 2.0, 2.0, 2.0, 1.5, 2.5, 0.0, 0.2, 0.0, 3.0])
    assert find_peaks(d, 0.5).tolist() == [3, 6] and find_peaks(d, 1.0).tolist() == [6]


@given(CURVES)
def test_largest_rebound_is_its_definition(d: np.ndarray) -> None:
    brute = max(d[j] - d[i] for i in range(len(d)) for j in range(i, len(d)))
    assert largest_rebound(d) == brute


def test_straight_line_by_hand() -> None:
    m = measure_curve(np.linspace(1, 0, 101), contact=40)
    # The median of 1, .99, .98, .97, .96 is .98; half of it is reached at 1 - t / 100 <= .49.
    assert m.start == pytest.approx(0.98) and m.end == 0
    assert (m.t_drop_10, m.t_drop_25, m.t_drop_50, m.contact_lag) == (12, 27, 51, 11)
    assert m.area == pytest.approx(0.5) and m.sigma == pytest.approx(0, abs=1e-12)


def test_noise_is_measured_before_contact_and_blind_to_a_slope() -> None:
    rng = np.random.default_rng(1)
    d = np.linspace(1, 0, 4000) + rng.normal(0, 0.01, 4000)
    d[2000:] += rng.normal(0, 0.5, 2000)
    assert noise(d, contact=2000) == pytest.approx(0.01, rel=0.05)
    assert noise(d, contact=3) > 0.02  # too few frames: the whole curve


def test_flat_window_makes_no_peak_of_rounding() -> None:
    d = STEP + 1e-6 * np.cos(np.arange(100))
    d[:50] = 1
    m = measure_curve(d, contact=50)
    assert (m.sigma, m.eps, m.peaks) == (0, EPS_FLOOR, 0)


@pytest.mark.parametrize("wiggle", [0.0, 1e-7])
def test_constant_curve_is_undefined_not_perfect(wiggle: float) -> None:
    m = measure_curve(0.7 + wiggle * np.sin(np.arange(60)), contact=None)
    assert (m.spearman, m.kendall_tau_b, m.t_drop_10, m.t_drop_50) == (None,) * 4
    assert m.area == pytest.approx(0.7)
