"""Conformal threshold of success."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from touchgoal.rewards.report.record import Facts
from touchgoal.rewards.report.tables import SUCCESSES, success_table
from touchgoal.rewards.success import SUCCESS, fit_success, load_success_threshold
from touchgoal.runtime.errors import UserError


@pytest.mark.parametrize(("demonstrations", "bound"), [(9, 0.1), (12, 0.1), (19, 0.05), (50, 0.2)])
def test_rejected_successes_stay_within_the_bound(demonstrations: int, bound: float) -> None:
    """Over exchangeable costs of any distribution, the bound holds and is not wasted."""
    rng, trials = np.random.default_rng(0), 4000
    costs = rng.gamma(0.5, size=(trials, demonstrations + 1))
    rejected = [not fit_success(row[1:].tolist(), bound).accepts(float(row[0])) for row in costs]
    sigma = np.sqrt(bound * (1 - bound) / trials)
    assert bound - 1 / (demonstrations + 1) - 3 * sigma < np.mean(rejected) < bound + 3 * sigma


def test_too_few_demonstrations_are_refused() -> None:
    with pytest.raises(UserError, match="reject at most 10% .* at least 9 demonstrations .*are 8"):
        fit_success([0.1] * 8, 0.1)
    with pytest.raises(UserError, match="must be in"):
        fit_success([0.1] * 18, 0.0)


def test_stored_beside_the_normalizer(tmp_path: Path) -> None:
    normalizer = tmp_path / "normalizer.json"
    normalizer.touch()
    assert load_success_threshold(normalizer) is None and load_success_threshold("none") is None
    threshold = fit_success(np.linspace(0, 1, 9).tolist())
    threshold.save(tmp_path / SUCCESS)
    assert load_success_threshold(normalizer) == threshold
    assert "at most 1.000; it rejects at most 10% of successes like its 9" in str(threshold)
    (tmp_path / SUCCESS).write_text("[]")
    with pytest.raises(UserError, match="no success threshold"):
        load_success_threshold(normalizer)


def facts(outcome: str, last: float, name: str = "a") -> Facts:
    return Facts(
        name=name, source=name, index=0, offset=0, frames=9, fps=20.0, unit="", normalised=True,
        goal={}, own_goal=False, contact=None, contact_source="no touch", object="",
        outcome=outcome, success=outcome == "success" if outcome else None,
        measured={"fused": {"end": last}}, peaks={}, shown=[], columns=[],
    )  # fmt: skip


def test_the_table_says_what_is_accepted_and_what_is_unknown(tmp_path: Path) -> None:
    threshold = fit_success(np.linspace(0.1, 0.9, 9).tolist())
    measured = [facts("success", 0.2), facts("success", 0.95, "b"), facts("off", 0.3, "c")]
    table = success_table(measured, threshold, tmp_path)
    assert "success: 1 of 2 accepted" in table and "off: 1 of 1 accepted" in table
    assert "unknown" not in table
    lines = (tmp_path / SUCCESSES).read_text().splitlines()
    assert lines == ["name,last_cost,success", "a,0.2000,yes", "b,0.9500,no", "c,0.3000,yes"]
    table = success_table([replace(facts("", 0.2), own_goal=True)], threshold, tmp_path)
    assert "how many failures pass is unknown" in table and "costs 0 whatever happened" in table
