"""Demonstrations of mixed quality, without a mistake or with one: by the feedback expert, by a led hand."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from benchmarks.papers.reward_objects import HELD_OUT_OBJECTS
from benchmarks.papers.reward_quality.recording import Recorded
from touchgoal.control.deployment.scripted import PickPlacePoses
from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.teleoperation.device import TeleoperationConfig
from touchgoal.control.teleoperation.scripted_device import ScriptedDevice
from touchgoal.control.teleoperation.teleoperator import Teleoperator
from touchgoal.episodes.recording import EpisodeSpec, Roles, collect, missing_specs
from touchgoal.episodes.schema import MetaValue
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime import seeds
from touchgoal.runtime.parallel.parallel_map import Workers
from touchgoal.sim_envs.cell.hardware import GRIPPER_MAX_WIDTH
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.experts.pick_place_feedback import FeedbackExpert
from touchgoal.sim_envs.pick_place import PickPlace

Mistake = Literal["none", "beside", "above", "drop", "freeze", "off"]
"""Mistake of a demonstration, in this order: none; the object is put down 4 to 8 cm beside the goal; the
hand closes 5 to 8 cm above the object; it lets go on the way; it stops somewhere; the object is put down
2.5 to 3 cm beside the goal."""
_RIGHT: tuple[Mistake, ...] = ("none",)
_MISTAKES: tuple[Mistake, ...] = ("beside", "above", "drop", "freeze")
_TWENTY: tuple[Mistake, ...] = (*_RIGHT * 8, *_MISTAKES * 3)  # eight of twenty are right
_LED_MISTAKES: tuple[Mistake, ...] = ("beside", "off", "above", "off")
_LED_TWENTY: tuple[Mistake, ...] = (*_RIGHT * 8, *_LED_MISTAKES * 3)
_LED_SECONDS = 30.0  # s that a led hand has
_DISTURBANCE = 0.01  # m/s, so that corrections are shown
_CARRIED = (0.5, 1.5)  # s between grasp and letting go
_STOPS = (1.0, 4.0)  # s from the start
_FIRST_SEED = seeds.REWARD_TEST.start + 700_000  # the judged episodes of reward-quality end before


@dataclass(frozen=True)
class MixedRoles:
    """Actor and expert of a recording, see `Roles` in `episodes/recording.py`."""

    mistakes: tuple[Mistake, ...] = _TWENTY  # taken in turn by the episode's seed

    def __call__(self, env: Any, spec: EpisodeSpec) -> tuple["MistakenExpert", "MistakenExpert"]:
        """Return one hand for both roles: its mistakes are what is recorded."""
        expert = MistakenExpert(env, self.mistakes[spec.seed % len(self.mistakes)])
        return expert, expert


class MistakenExpert(Actor):
    """The feedback expert with one mistake."""

    def __init__(self, env: PickPlace, mistake: Mistake) -> None:
        """Begin an episode right after its reset."""
        rng, hz = env.np_random.spawn(1)[0], env.config.control_hz
        self._env, self._mistake = env, mistake
        self._ticks_left = round(hz * rng.uniform(*(_CARRIED if mistake == "drop" else _STOPS)))
        object_error, goal_error = _errors(mistake, rng)
        self._expert = FeedbackExpert(env, object_error, goal_error)
        self._last = np.append(np.zeros(env.n_joints), GRIPPER_MAX_WIDTH)

    def act(self, observation: Observation) -> Float[np.ndarray, " n"]:
        """Return the next action, from ground truth; call it at every tick."""
        if self._mistake == "freeze" or (self._mistake == "drop" and self._holds()):
            self._ticks_left -= 1
        if self._ticks_left < 0:
            width = GRIPPER_MAX_WIDTH if self._mistake == "drop" else self._last[-1]
            return np.append(np.zeros(self._env.n_joints), width)
        self._last = self._expert.act(observation)
        return self._last

    def _holds(self) -> bool:
        return all(pad.touching for pad in self._env.pad_contacts())


class LedHand(Actor):
    """The scripted teleoperation device with one mistake; it lets go at the end."""

    def __init__(self, env: PickPlace, mistake: Mistake, seed: int) -> None:
        """Begin an episode right after its reset."""
        object_error, goal_error = _errors(mistake, env.np_random.spawn(1)[0])
        layout = env.scene_layout()
        grasp = np.array(layout["grasp"]) + np.append(object_error, 0)
        goal = np.array(layout["goal"]) + goal_error[:2]
        poses = PickPlacePoses(tuple(grasp), tuple(goal))
        safety = ActionFilter(env.robot, env.config.control_hz)
        device = ScriptedDevice(poses, seed)
        self._hand = Teleoperator(device, safety, lambda: env.command, TeleoperationConfig())
        self._begun = False

    def act(self, observation: Observation) -> Float[np.ndarray, " n"]:
        """Return the next action."""
        if not self._begun:
            self._hand.start(observation)
            self._begun = True
        return self._hand.act(observation)


def led_hand(env: Any, spec: EpisodeSpec) -> tuple[LedHand, LedHand]:
    """Return one hand for both roles of a recording; its mistakes are taken in turn by the seed."""
    hand = LedHand(env, _LED_TWENTY[spec.seed % len(_LED_TWENTY)], spec.seed)
    return hand, hand


def _errors(mistake: Mistake, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much (m) a mistake misses the object, and the goal."""
    object_error, goal_error = np.zeros(3), np.zeros(3)
    if mistake == "above":
        object_error[2] = rng.uniform(0.05, 0.08)
    if mistake in ("beside", "off"):
        near = (0.04, 0.08) if mistake == "beside" else (0.025, 0.03)
        angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(*near)
        goal_error[:2] = distance * np.array([np.cos(angle), np.sin(angle)])
    return object_error, goal_error


def record_mixed(
    folder: Path,
    count: int,
    env: PickPlaceConfig,
    workers: Workers,
    objects: Sequence[str] | None = None,  # default: those held out
) -> list[Recorded]:
    """Record `count` demonstrations, right and wrong; return them with what came of each."""
    first = _FIRST_SEED if objects is None else _FIRST_SEED + 60_000
    moved = replace(env, disturbance=_DISTURBANCE)
    return _record(folder, count, first, MixedRoles(), moved, workers, objects)


def record_right(
    folder: Path, count: int, env: PickPlaceConfig, workers: Workers
) -> list[Recorded]:
    """Record `count` demonstrations without a mistake, to validate on."""
    moved = replace(env, disturbance=_DISTURBANCE)
    return _record(folder, count, _FIRST_SEED + 50_000, MixedRoles(_RIGHT), moved, workers)


def record_led(folder: Path, count: int, env: PickPlaceConfig, workers: Workers) -> list[Recorded]:
    """Record `count` demonstrations of a led hand, right and wrong."""
    env = replace(env, release=True, max_seconds=_LED_SECONDS)
    return _record(folder, count, _FIRST_SEED + 90_000, led_hand, env, workers)


def _record(
    folder: Path,
    count: int,
    seed: int,
    roles: Roles,
    env: PickPlaceConfig,
    workers: Workers,
    objects: Sequence[str] | None = None,  # default: those held out
) -> list[Recorded]:
    objects = objects or HELD_OUT_OBJECTS
    specs = [
        EpisodeSpec(seed + k, options={"object": objects[(k + k // 20) % len(objects)]})
        for k in range(count)
    ]
    missing = missing_specs(folder, specs)
    if missing:
        collect(folder, env, missing, workers, roles)
    episodes = EpisodeSet(folder)
    mistakes = _LED_TWENTY if roles is led_hand else _TWENTY
    return [
        Recorded(
            folder,
            i,
            "test",
            _kind(episodes.meta(i), mistakes),
            str(episodes.meta(i)["object"]),
            "elsewhere",
        )
        for i in range(count)
    ]


def _kind(meta: Mapping[str, MetaValue], mistakes: Sequence[Mistake]) -> str:
    """Return "success", or the mistake of a demonstration that failed."""
    mistake = mistakes[int(str(meta["seed"])) % len(mistakes)]
    if meta["success"]:
        return "success"
    return "failure" if mistake == "none" else mistake
