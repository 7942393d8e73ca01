"""Soft actor-critic on lift-and-hold: the sparse reward alone, and shaped by the fall of the cost.

The hand starts open around the object's top. Lifting the object by 2 cm and holding it there for a
quarter of a second pays 1 and ends the episode; chance does so in 6 of 100 episodes. An action lasts 0.2 s. The
shaped reward adds gamma (1 - c') - (1 - c), with c the cost to the ends of scripted successes: potential-based
shaping (Ng 1999) with 1 - c as the potential, 0 where an episode begins. The policy reads the hand's place,
width and force; touch reaches it through the cost alone. Needs stable-baselines3, which is in the `dev` extra.
"""

import tempfile
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
import torch
from jaxtyping import Float, Float32

from benchmarks.options import BenchmarkOptions
from touchgoal.control import features as ft
from touchgoal.control.features import CONTROL_HZ, Observation
from touchgoal.control.motion.rotations import fingers_down, rotation_vector
from touchgoal.episodes.schema import Episode
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.rewards.distance.fit_normalizer import fit_normalizer
from touchgoal.rewards.distance.normalizer import NORMALIZER
from touchgoal.rewards.features.successful_ends import GOAL_FILE, SuccessfulEnds
from touchgoal.rewards.online import CostMeter
from touchgoal.rewards.prepared_reward import PreparedReward
from touchgoal.rewards.reward import Reward
from touchgoal.rewards.reward_wrapper import inputs_of
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.json_file import parse_json, write_json
from touchgoal.runtime.option_types import Count, Fraction, Positive, checked_dataclass
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.experts.pick_place_plans import LOWEST_GRASP
from touchgoal.sim_envs.pick_place import PickPlace

_LIFTED = 0.02  # m
_ABOVE, _ASIDE = 0.01, 0.005  # m of the hand from its grasp at the start; beside it at most
_TICKS = 4  # of an action: an arm that changes its mind at every tick hardly ever closes its hand
_SPEED = 0.1 / CONTROL_HZ  # m a tick of an action of 1 along each axis
_PLACE = {"start": (0.5, 0.0), "goal": (0.5, 0.15)}  # m: images of the goals must be comparable
SCRIPT = [[0, 0, -0.5, 1]] + [[0, 0, 0, -1]] * 3 + [[0, 0, 1, -1]] * 6  # actions of a success
_GOAL_SEED = seeds.REWARD_GOALS.start + 95_000
_TRIAL_SEED = seeds.POLICY_TEST.start + 900_000
Arm = Literal["sparse", "shaped"]
Seen = Float32[np.ndarray, "8"]


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark shaping."""

    arms: tuple[Arm, ...] = get_args(Arm)
    """Rewards to train with."""
    seeds: Count = 5
    """Trainings of each reward, each with another seed."""
    decisions: Count = 3000
    """Decisions of a training, each for 0.2 s."""
    every: Count = 250
    """Decisions between two evaluations."""
    trials: Count = 20
    """Episodes of an evaluation, without exploration; the same for all."""
    goals: Count = 5
    """Scripted successes that give the goals and the units of the cost."""
    gamma: Fraction = 0.95
    """Discount of a decision."""
    entropy: Positive = 0.02
    """Coefficient of the entropy at the start. From 1, Stable-Baselines3's own, nothing was learnt in 6000
    ticks: it outweighs a reward of 1."""
    lr: Positive = 1e-3
    """Learning rate."""
    env: PickPlaceConfig = PickPlaceConfig(objects=("wooden_block",), cameras=(), max_seconds=3.0)
    """Environment of the cost; with cameras, images count in it, too, and a tick takes longer."""
    workers: Count = 1
    """Trainings at a time."""


class LiftAndHold(PickPlace):
    """Lift the object by 2 cm and hold it there for a quarter of a second, for a reward of 1."""

    task = "lift-and-hold"

    def start_joints(self, rng: np.random.Generator) -> Float[np.ndarray, " n"]:
        """Draw joint positions (rad) that hold the open hand around the object's top."""
        place = self.object_pose()[:3] + np.append(rng.uniform(-_ASIDE, _ASIDE, 2), 0)
        place[2] = max(place[2], LOWEST_GRASP) + _ABOVE
        return self.kinematics.solve_ik(place, fingers_down(self.grasp_yaw()), self.robot.arm.home)

    def evaluate(self) -> tuple[float, bool]:
        """Return 1 on success, else 0, and success; count the ticks for which the object is up."""
        held = all(pad.touching for pad in self.pad_contacts())
        up = held and self.object_pose()[2] - self.start[2] > _LIFTED
        self._still_ticks = self._still_ticks + 1 if up else 0
        success = self._still_ticks >= self.config.control_hz / 4
        return float(success), success


class HandControl(gym.Wrapper):
    """Four actions in [-1, 1], the hand's velocity and target width for a step; eight numbers observed.

    With a reward, steps pay the potential's gain, too.
    """

    def __init__(
        self, hand: LiftAndHold, reward: PreparedReward | None = None, gamma: float = 1.0
    ) -> None:
        super().__init__(hand)
        self._hand, self._reward, self._gamma = hand, reward, gamma
        self._meter: CostMeter | None = None
        self.seen: list[Observation] = []  # of this episode, at each tick
        self.action_space = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (8,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Seen, dict[str, Any]]:
        """Start an episode with the object in its one place."""
        observation, info = self._hand.reset(seed=seed, options=_PLACE)
        self._start, self._upright = self._hand.kinematics.forward(self._hand.command)
        self.seen = [observation]
        if self._reward is not None:
            self._meter = CostMeter(self._reward, rate=CONTROL_HZ / _TICKS)
            self._cost = self._measure(self._meter)
        return self._vector(), info

    def step(self, action: np.ndarray) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        """Move the hand upright, and never below its grasp: it could press on the table."""
        paid, ended, late, info = self._tick(action)
        for _ in range(_TICKS - 1):
            if ended or late:
                break
            paid, ended, late, info = self._tick(action)
        if self._meter is not None:
            before, self._cost = self._cost, self._measure(self._meter)
            paid += self._gamma * (1 - self._cost) - (1 - before)
        return self._vector(), float(paid), ended, late, info

    def _tick(self, action: np.ndarray) -> tuple[float, bool, bool, dict[str, Any]]:
        hand = self._hand
        position, R = hand.kinematics.forward(hand.command)
        shift = _SPEED * np.clip(action[:3], -1, 1)
        shift[2] = max(shift[2], self._start[2] - _ABOVE - position[2])
        change = np.append(shift, R @ rotation_vector(R.T @ self._upright) / 4)
        width = (action[3] + 1) / 2 * hand.robot.tool.stroke[1]
        joints = np.append(hand.kinematics.joint_change(hand.command, change), width)
        observation, paid, ended, late, info = hand.step(joints)
        self.seen.append(observation)
        return paid, ended, late, info

    def _measure(self, meter: CostMeter) -> float:
        for observation in self.seen[-_TICKS:]:
            meter.add(observation)
        reading = meter.measure()
        assert reading is not None  # of the observations just added
        return reading.cost

    def _vector(self) -> Seen:
        """Return place (3) and width in units of 2 cm, force (3) of 10 N, and the time in s."""
        observation = self.seen[-1]
        place, width = observation[ft.TCP_POSE][:3] - self._start, observation[ft.STATE][-1]
        force, time = observation[ft.WRENCH][:3], len(self.seen) / CONTROL_HZ
        return np.array([*place / 0.02, width / 0.02, *force / 10, time], np.float32)


def run(config: Config) -> dict[str, Any]:
    """Train what is missing; return the curves of success."""
    jobs = list(product(config.arms, range(config.seeds)))
    with tempfile.TemporaryDirectory() as folder:
        out = config.out or Path(folder)
        if not (out / GOAL_FILE).is_file():
            _fit(config, out)
        files = [out / f"{arm}-{seed}.json" for arm, seed in jobs]
        missing = [job for job, file in zip(jobs, files, strict=True) if not file.is_file()]
        with parallel_map(partial(_train, config, out), missing, config.workers) as results:
            list(track(results, "training", "run", total=len(missing)))
        read = [parse_json(file.read_bytes()) for file in files]
    curves = {arm: read[i * config.seeds :][: config.seeds] for i, arm in enumerate(config.arms)}
    lines = [f"{'decisions':>9}  " + "".join(f"{arm:<42}" for arm in config.arms)]
    for i, now in enumerate(zip(*read, strict=True)):
        lines.append(f"{(i + 1) * config.every:>9}  ")
        for k in range(len(config.arms)):
            each = now[k * config.seeds :][: config.seeds]
            rate = SuccessRate(sum(each), config.trials * config.seeds)
            lines[-1] += f"{rate} ({', '.join(map(str, each))})".ljust(42)
    return {"table": "\n".join(lines), "trials": config.trials, "curves": curves}


def _fit(config: Config, out: Path) -> None:
    """Fit goals and units on scripted successes, as fit-normalizer does."""
    env = LiftAndHold(config.env)
    hand, embedder, ends = HandControl(env), Reward().embedder(inputs_of(env)), []
    for seed in range(_GOAL_SEED, _GOAL_SEED + config.goals):
        hand.reset(seed=seed)
        success = any(hand.step(np.array(action))[2] for action in SCRIPT)
        keys = [key for key in (*ft.CAMERAS, *ft.TACTILE, ft.WRENCH) if key in hand.seen[0]]
        episode = Episode({key: np.stack([o[key] for o in hand.seen]) for key in keys}, "", {})
        facts = {"success": success, "object": config.env.objects[0]}
        ends.append(embedder.embed_chunks([episode], CONTROL_HZ, "a goal").with_facts(facts))
    fit_normalizer(ends, ends[0].modalities, env.task).save(out / NORMALIZER)
    SuccessfulEnds.of(ends).save(out / GOAL_FILE)


def training_env(config: Config, out: Path, arm: Arm) -> HandControl:
    """Return the environment with a reward; the cost is to the goals in `out`."""
    if arm == "sparse":
        return HandControl(LiftAndHold(replace(config.env, tactile=False, cameras=())))
    env, goal = LiftAndHold(config.env), f"goal:{out / GOAL_FILE}"
    reward = Reward(goal, normalizer=out / NORMALIZER).prepare(inputs_of(env))
    return HandControl(env, reward, config.gamma)


def _train(config: Config, out: Path, job: tuple[Arm, int]) -> None:
    """Train with a reward and a seed; write the number of successes at each evaluation."""
    try:
        from stable_baselines3 import SAC
    except ImportError as error:
        raise UserError("pip install stable-baselines3, which trains here") from error
    torch.set_num_threads(1)
    arm, seed = job
    env, trials = training_env(config, out, arm), training_env(config, out, "sparse")
    entropy, curve = f"auto_{config.entropy}", []
    model = SAC(
        "MlpPolicy", env, config.lr, gamma=config.gamma, ent_coef=entropy, seed=seed, device="cpu"
    )
    for _ in range(config.decisions // config.every):
        model.learn(config.every, reset_num_timesteps=False)
        curve.append(sum(_succeeds(model, trials, _TRIAL_SEED + k) for k in range(config.trials)))
    write_json(out / f"{arm}-{seed}.json", curve)


def _succeeds(model: Any, hand: HandControl, seed: int) -> bool:
    """Run an episode without exploration; return whether the object is lifted and held."""
    (state, info), over = hand.reset(seed=seed), False
    while not over:
        state, _, ended, late, info = hand.step(model.predict(state, deterministic=True)[0])
        over = ended or late
    return bool(info[ft.TRUTH_SUCCESS][0])
