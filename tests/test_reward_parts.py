"""Named parts of a cost: distances, units, gate, smoothing, fusion, value; in one go and streamed."""

from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from toy_towers import PaintTowers

from touchgoal.control.features import FRONT, TACTILE_LEFT, TACTILE_RIGHT, WRIST
from touchgoal.control.tactile.sensor_models import SENSORS
from touchgoal.rewards.curves import Contact
from touchgoal.rewards.distance.cost import compute_curves
from touchgoal.rewards.distance.fit_normalizer import fit_normalizer, fit_units
from touchgoal.rewards.distance.normalizer import DistanceNormalizer, EmbeddingSource
from touchgoal.rewards.distance.parts import (
    goal_spread,
    object_distances,
    part_costs,
    part_distances,
    smooth_and_fuse,
    soft_minimum,
)
from touchgoal.rewards.features.contact_reading import ContactReader, SlipMeter
from touchgoal.rewards.features.embedded import (
    EmbeddedEpisode,
    EmbeddedGoal,
    Features,
    last_rows,
    take_rows,
)
from touchgoal.rewards.features.successful_ends import SuccessfulEnds
from touchgoal.rewards.reward import Reward
from touchgoal.rewards.reward_wrapper import RewardWrapper
from touchgoal.rewards.value import Value, fit_value
from touchgoal.runtime.errors import UserError

N, GRASP = 40, 15


def embedded(
    seed: int, success: bool = True, force: float = 10.0, slip: float = 0.0, pressed: float = 0.0
) -> EmbeddedEpisode:
    """Two cameras that see the progress in their first channel, and a grasp from `GRASP` on.

    It ends `slip` m from where it was grasped, with `pressed` N on the arm.
    """
    rng = np.random.default_rng(seed)
    progress = np.linspace(0, 1 if success else 0.4, N)

    features: dict[str, np.ndarray] = {}
    for name in ("front", "wrist"):
        maps = rng.normal(0, 0.1, (N, 4, 3, 3)).astype(np.float32)
        maps[:, 0, 1, 1] += 2 * progress - 1
        maps[:, 1] += 1
        features[name] = np.stack([np.cos(progress), np.sin(progress)], 1).astype(np.float32)
        features[f"{name}_map"] = maps.astype(np.float16)
    held = np.repeat((np.arange(N) >= GRASP)[:, None], 2, axis=1)
    wrench = rng.normal(0, 0.3, (N, 6))
    wrench[:, 2] += pressed * progress
    noise = rng.normal(0, 0.1, (N, 2)) * held
    numbers = {
        "touch": np.stack([held + noise, held + 0 * noise], -1) / 2**0.5,
        "force": held * (force + rng.normal(0, 0.5, (N, 2))),
        "centre": held[..., None] * rng.normal(1e-3, 1e-4, (N, 2, 2)),
        "slip": held * (slip * progress[:, None] + rng.uniform(0, 1e-4, (N, 2))),
        "wrench": wrench,
    }
    features |= {name: values.astype(np.float32) for name, values in numbers.items()}
    return EmbeddedEpisode(
        features | {"image": features["front"], "held": held},
        EmbeddingSource("offline", FRONT, "encoder", "gelsight_mini"),
        f"episode {seed}",
        20.0,
        (TACTILE_LEFT, TACTILE_RIGHT),
        Contact(GRASP, "detected"),
        object="apple",
        success=success,
    )


def end_of(episode: EmbeddedEpisode) -> EmbeddedGoal:
    return EmbeddedGoal(last_rows([episode]))


@pytest.fixture(scope="module")
def successes() -> list[EmbeddedEpisode]:
    return [embedded(seed) for seed in range(6)]


@pytest.fixture(scope="module")
def normalizer(successes: list[EmbeddedEpisode]) -> DistanceNormalizer:
    return fit_normalizer(successes, ("image", "tactile"), "simulated pick-place")


@pytest.fixture(scope="module")
def value(successes: list[EmbeddedEpisode]) -> Value:
    return fit_value(successes, "simulated pick-place")


def test_a_failure_of_each_part_raises_that_part(
    successes: list[EmbeddedEpisode], normalizer: DistanceNormalizer, value: Value
) -> None:
    goal = end_of(successes[0])
    ends = (
        embedded(9),
        embedded(9, force=40.0),
        embedded(9, success=False),
        embedded(9, slip=5e-3),
        embedded(9, pressed=30.0),
    )
    parts = [compute_curves(end, goal, normalizer, value).parts for end in ends]
    good, hard, early, slid, pressed = parts
    assert {name: cost[-1] < 0.5 for name, cost in good.items()} == dict.fromkeys(good, True)
    for failure, name in ((hard, "force"), (slid, "slip"), (pressed, "wrench")):
        assert failure[name][-1] > good[name][-1] + 0.4
        assert failure["fused"][-1] > good["fused"][-1] + 0.05
    for name in ("front", "wrist", "wrist_map", "value", "fused"):
        assert early[name][-1] > good[name][-1] + 0.2, name
    for cost in good.values():
        assert 0 <= cost.min() and cost.max() <= 1


def test_a_force_is_a_goal(
    successes: list[EmbeddedEpisode], normalizer: DistanceNormalizer
) -> None:
    """Alone or beside a touch, whose own force it replaces; its unit is half of it."""
    newtons, forms = {"force": np.full((1, 2), 8, np.float32)}, {"force": "force:8"}
    mine, alone = embedded(9, force=12.0), EmbeddedGoal(newtons, forms)
    costs = compute_curves(mine, alone, normalizer)
    assert costs.parts.keys() == {"force", "fused"} and costs.plain.keys() == {"force"}
    assert costs.parts["force"][:GRASP] == pytest.approx(np.ones(GRASP))
    assert costs.parts["force"][-1] == pytest.approx(0.31, abs=0.1)  # 4^2 / (4^2 + 6^2)
    raw = compute_curves(mine, alone, None).costs["force"]
    assert raw[:GRASP] == pytest.approx(np.ones(GRASP)) and raw[-1] == pytest.approx(0.5, abs=0.15)
    touch = EmbeddedGoal({**last_rows([successes[0]]), **newtons}, forms)
    beside = compute_curves(mine, touch, normalizer).parts
    assert beside["force"] == pytest.approx(costs.parts["force"]) and "object" in beside


def test_before_contact_the_fingertips_cost_the_same_whatever_they_read(
    successes: list[EmbeddedEpisode], normalizer: DistanceNormalizer
) -> None:
    goal = end_of(successes[0])
    parts = compute_curves(embedded(9), goal, normalizer).parts
    for name in ("object", "force", "centre", "held"):
        assert parts[name][:GRASP] == pytest.approx(np.ones(GRASP)), name
    fused, others = parts["fused"], [cost for name, cost in parts.items() if name != "fused"]
    assert fused == pytest.approx(np.sqrt(np.mean(np.square(others), axis=0)))
    assert np.ptp(parts["wrist_map"][:GRASP]) > 0.05 and np.ptp(fused[:GRASP]) > 0  # images lead
    free = {**goal.features, "held": np.zeros((1, 2), bool)}
    costs = part_costs(embedded(9).features, free, normalizer.unit)
    assert costs["object"][:GRASP] == pytest.approx(np.zeros(GRASP)) and costs["object"][-1] < 0.5


def test_pieces_of_a_trajectory_cost_the_same_as_the_whole(
    successes: list[EmbeddedEpisode], normalizer: DistanceNormalizer, value: Value
) -> None:
    """So costs are causal: a streamed frame knows no later one."""
    goal = end_of(successes[0])
    whole = compute_curves(embedded(9), goal, normalizer, value).parts
    before: dict[str, float] = {}
    for t in range(N):
        tick = embedded(9).take(slice(t, t + 1))
        parts = compute_curves(tick, goal, normalizer, value, before).parts
        before = {name: float(cost[-1]) for name, cost in parts.items()}
        assert before == pytest.approx({name: cost[t] for name, cost in whole.items()}, abs=1e-6)


def test_distances_by_hand() -> None:
    def readings(touching: list[bool], force: list[float], x: list[float]) -> Features:
        centre = np.stack([x, np.zeros(len(x))], 1)[:, None].astype(np.float32)
        numbers = np.array(force, np.float32)[:, None]
        touch = np.ones((len(x), 1, 2), np.float32)
        held = np.array(touching)[:, None]
        return {"touch": touch, "held": held, "force": numbers, "centre": centre}

    light = readings([True, False], [9.5, 0], [3e-3, 0])
    d = part_distances(light, readings([True], [39.5], [0]))
    wanted = {"force": np.full((1, 1), 39.5, np.float32)}
    assert part_distances(light, wanted)["force"][:, 0].tolist() == [30, 39.5]
    assert d["centre"][:, 0] == pytest.approx([3e-3, 0.02]) and d["held"][:, 0].tolist() == [0, 1]
    along, short = np.array([[[1.0, 0]]], np.float32), np.array([[[0.5, 0]]], np.float32)
    assert object_distances(along, along)[0, 0] == 0
    assert object_distances(short, along)[0, 0] == pytest.approx(0.125)
    two = soft_minimum(np.array([[0.1, 0.4], [0.3, 0.3]]))
    assert two == pytest.approx([0.1, 0.3], abs=1e-4)
    cost = np.random.default_rng(0).random(9)
    whole, begun = (smooth_and_fuse({"held": c}, 20, None)["held"] for c in (cost, cost[:4]))
    after = smooth_and_fuse({"held": cost[4:]}, 20, {"held": float(begun[-1])})["held"]
    assert np.concatenate([begun, after]) == pytest.approx(whole)


def test_a_grasp_slips_from_where_it_settled() -> None:
    """At 10 frames a second it settles for four; two frames without contact do not end it."""
    meter = SlipMeter(10)
    settling = [meter.update(True, (x * 1e-3, 0.0)) for x in (5, 3, 1, 0)]
    assert settling == [0, 0, 0, 0]
    assert meter.update(True, (0.0, 2e-3)) == pytest.approx(2e-3)
    assert [meter.update(False, (0.0, 0.0)) for _ in range(2)] == pytest.approx([2e-3, 2e-3])
    assert meter.update(True, (3e-3, 0.0)) == pytest.approx(3e-3)
    assert [meter.update(False, (0.0, 0.0)) for _ in range(5)][-1] == 0
    assert meter.update(True, (9e-3, 0.0)) == 0, "a new grasp"


def test_goals_that_differ_widen_the_unit(successes: list[EmbeddedEpisode]) -> None:
    """An object held elsewhere each time is not blamed for it; one goal alone says nothing."""
    one = end_of(successes[0])
    assert goal_spread(one.features) == {}
    ends = take_rows(successes[0].features, slice(-3, None))
    centre = ends["centre"] + np.array([0, 6e-3, 12e-3], np.float32)[:, None, None]
    apart = {**ends, "centre": centre}
    assert goal_spread(apart)["centre"] == pytest.approx(6e-3 * 2**0.5, rel=0.1)
    mine, units = embedded(9).features, {"centre": 2e-4}
    costs = [part_costs(mine, goal, units)["centre"][-1] for goal in (one.features, apart)]
    assert costs[1] < 0.1 < costs[0]


def test_units_are_those_of_ends_with_the_same_object(successes: list[EmbeddedEpisode]) -> None:
    units = fit_units(successes)
    assert 0.5 <= units["force"] < 2 and units["held"] == pytest.approx(1 / 3)
    strangers = [replace(e, object=str(i)) for i, e in enumerate(successes)]
    assert fit_units(strangers) == {}


def test_a_value_is_refused_elsewhere(successes: list[EmbeddedEpisode], value: Value) -> None:
    fitted = "simulated pick-place", (FRONT, WRIST), "offline"
    assert value.mismatch(*fitted) is None
    assert "'simulated pick-place', not 'pour'" in str(value.mismatch("pour", *fitted[1:]))
    assert "with the towers offline, not clip" in str(value.mismatch(*fitted[:2], "clip"))
    assert "looks through" in str(value.mismatch(fitted[0], (FRONT,), "offline"))
    with pytest.raises(UserError, match="at least 4 successful episodes"):
        fit_value(successes[:3], "pour")
    assert np.corrcoef(value.progress(embedded(9).features), np.arange(N))[0, 1] > 0.9


def test_a_press_is_read_where_and_how_hard_it_is() -> None:
    """A disc that darkens the gel right of the middle; the sensor's own file reads a depth of it."""
    rng = np.random.default_rng(0)
    gel = np.full((240, 320, 3), 110, np.uint8) + rng.integers(0, 3, (240, 320, 3), dtype=np.uint8)
    y, x = np.mgrid[:240, :320]
    ball = np.exp(-((x - 220) ** 2 + (y - 120) ** 2) / 800)
    pressed = gel.astype(np.float32)
    pressed[..., 0] += 60 * np.gradient(ball, axis=1) / np.abs(np.gradient(ball, axis=1)).max()
    frames = np.stack([gel] * 6 + [np.clip(pressed, 0, 255).astype(np.uint8)] * 3)
    readings = ContactReader(SENSORS["gelsight_mini"], frames[:5], 20.0).read(frames)
    assert readings["held"].tolist() == [False] * 6 + [True] * 3 and len(readings["centre"]) == 9
    assert readings["force"][:6].tolist() == [0] * 6 and readings["force"][-1] > 0
    for unmeasured in (None, replace(SENSORS["gelsight_mini"], measured=False)):
        blind = ContactReader(unmeasured, frames[:5], 20.0).read(frames)
        assert blind.keys() == {"held"} and blind["held"].tolist() == readings["held"].tolist()


def test_ends_are_a_goal_chosen_by_object(successes: list[EmbeddedEpisode], tmp_path: Path) -> None:
    others = [replace(e, object="pear") for e in successes[:2]]
    SuccessfulEnds.of([*successes, *others]).save(tmp_path / "goal.npz")
    ends = SuccessfulEnds.load(tmp_path / "goal.npz")

    def chosen(own: EmbeddedEpisode) -> Features:
        return ends.for_trajectory(own, "goal")

    def count(own: EmbeddedEpisode) -> int:
        return len(chosen(own)["image"])

    other = embedded(9)
    assert len(ends.objects) == 8 and count(replace(other, object="pear")) == 2
    assert count(replace(other, object="")) == 8
    assert count(other) == 6 and count(successes[0]) == 5, "its own end is left out"
    with pytest.raises(UserError, match="no end with plum, only with apple, pear"):
        chosen(replace(other, object="plum"))
    mine = part_distances(other.features, chosen(other))
    last = [part_distances(other.features, last_rows([e])) for e in successes]
    for name, d in mine.items():
        assert d == pytest.approx(np.concatenate([one[name] for one in last], 1), abs=1e-6), name


class _Reaching(gym.Env):
    """A bright square that moves right, one step each; nothing touches the fingertips."""

    observation_space = gym.spaces.Dict({FRONT: gym.spaces.Box(0, 255, (32, 32, 3), np.uint8)})
    action_space = gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        self.at = 0
        return self.see(), {}

    def step(self, action: np.ndarray) -> tuple:
        self.at += int(action[0] > 0)
        return self.see(), 7.0, False, False, {}

    def see(self) -> dict[str, np.ndarray]:
        image = np.full((32, 32, 3), 60, np.uint8)
        image[12:20, self.at : self.at + 8] = 200
        return {FRONT: image}


def test_the_cost_rewards_an_environment() -> None:
    """A step towards the goal pays what the cost falls by; holding still pays nothing."""
    env = _Reaching()
    env.at = 12
    reward = Reward(env.see()[FRONT], towers=PaintTowers(), normalizer="none")
    rewarded = RewardWrapper(env, reward)
    _, info = rewarded.reset(seed=0)
    steps = [rewarded.step(np.array([a])) for a in (*[1.0] * 12, 0, 0, 0)]
    paid = [step[1] for step in steps]
    assert sum(paid) == pytest.approx(info["cost"]) and paid[12:] == [0, 0, 0]
    assert steps[-1][-1]["task_reward"] == 7.0
    with pytest.raises(UserError, match="not known before the end"):
        RewardWrapper(env, Reward(towers=PaintTowers(), normalizer="none"))
