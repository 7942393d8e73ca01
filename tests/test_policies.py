"""How sure a success rate is, and that trials on several cores are the trials on one."""

import pytest

from touchgoal.episodes.recording import EpisodeSpec
from touchgoal.policies.checkpoint import SHIPPED, SavedPolicy
from touchgoal.policies.evaluation.pick_place import evaluate
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.experts.pick_place import PickPlaceExpert


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [(8, 10, 0.49, 0.94), (16, 20, 0.58, 0.92), (10, 10, 0.72, 1.0), (0, 10, 0.0, 0.28)],
)
def test_wilson_interval(successes: int, trials: int, low: float, high: float) -> None:
    """Published values (Wilson 1927; the same from R's prop.test without correction)."""
    assert SuccessRate(successes, trials).interval == pytest.approx((low, high), abs=0.005)


def test_trials_depend_on_their_seed_alone() -> None:
    config = PickPlaceConfig(cameras=(), tactile=False)
    jobs = [EpisodeSpec(seed, options={"object": "toy_brick"}) for seed in (1, 2)]
    assert evaluate(config, PickPlaceExpert, jobs, workers=2) == [
        *evaluate(config, PickPlaceExpert, jobs[:1], workers=1),
        *evaluate(config, PickPlaceExpert, jobs[1:], workers=1),
    ]


def test_what_ships_picks_and_places() -> None:
    maker = SavedPolicy(SHIPPED["pick-place"])
    config = maker.env_config(PickPlaceConfig())
    assert config.cameras == ("front",) and config.tactile
    (trial,) = evaluate(config, maker, [EpisodeSpec(2_000_000)], workers=1)
    assert trial.success
