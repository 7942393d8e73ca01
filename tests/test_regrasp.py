"""A hand that closes on nothing, or loses its object, goes back and looks again; then it says that it failed."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from touchgoal.control import features as ft
from touchgoal.control.features import N_JOINTS, Observation
from touchgoal.policies.checkpoint import SHIPPED_POLICIES, SavedPolicy
from touchgoal.policies.evaluation.evaluate import GAVE_UP, run_trial, trial_specs
from touchgoal.policies.regrasp import Regrasp
from touchgoal.sim_envs.config import PickPlaceConfig

HZ, TICKS = 20.0, 2


def seen(joints: float, width: float) -> Observation:
    arm = np.full(N_JOINTS, joints)
    return {ft.STATE: np.array([*arm, *arm, width]), ft.COMMAND: np.array([*arm, *arm])}


def test_it_goes_back_at_a_bounded_speed_and_gives_up_after_two_more_tries() -> None:
    regrasp, first, way = Regrasp(HZ, TICKS), seen(0.0, 0.04), np.ones((1, 8))
    for miss in range(3):
        said = [regrasp.next(seen(0.3, 0.001), first, True, 0.0) for _ in range(3)]
        assert said == ["act", "act", "back"], "a glance at shut fingers is not enough"
        assert bool(regrasp.given_up) == (miss == 2)
        way = regrasp.way_back(seen(0.3, 0.001), first, 16)
        if miss < 2:
            assert np.abs(way[:, :-1]).max() <= 0.6 / HZ + 1e-6
            assert way[:, -1].min() == np.float32(0.08)
            assert way[:, :-1].sum(0) == pytest.approx(-0.3, abs=1e-6)
            assert regrasp.next(seen(0.1, 0.08), first, True, 0.08) == "back"
            assert regrasp.next(seen(0.01, 0.08), first, True, 0.08) == "look again"
    assert not way[:, :-1].any() and "3 of 3 tries" in regrasp.given_up


@pytest.mark.parametrize(("in_by", "feels"), [(0.005, True), (0.012, True), (0.0, False)])
def test_an_object_is_lost_once_the_fingers_close_in_on_where_it_was_or_feel_it_no_more(
    in_by: float, feels: bool
) -> None:
    regrasp, first = Regrasp(HZ, TICKS), seen(0.0, 0.04)
    for width in (0.08, 0.06, 0.03, 0.03, 0.03, 0.03, 0.03):
        assert regrasp.next(seen(0.3, width), first, True, 0.0) == "act"
    said = regrasp.next(seen(0.3, 0.03 - in_by), first, feels, 0.0)
    assert said == ("act" if feels and in_by < 0.01 else "back")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("interference", "seed", "mended"), [("taken", 8803, False), ("knocked", 8804, True)]
)
def test_an_object_taken_away_is_told_and_one_knocked_out_of_the_hand_is_placed(
    interference: Literal["taken", "knocked"], seed: int, mended: bool
) -> None:
    saved = SavedPolicy(SHIPPED_POLICIES["pick-place"])
    task = PickPlaceConfig(objects=("wooden_block",), max_seconds=20.0, as_deployed=True)
    task = saved().env_config(replace(task, interference=interference))
    [spec] = trial_specs(task, 1, seed)
    trial = run_trial(task, saved, spec)
    assert trial.success is mended and trial.seconds < 15
    assert trial.failure == ("" if mended else GAVE_UP)
