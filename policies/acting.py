"""Learned policy: `reset()` begins an episode, `act(observation)` returns a tick's action."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Protocol, TypeVar, cast, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float16, Float32, UInt8
from torch import Tensor

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Planner
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.policies.network import NOVEL_SECONDS, ObservationBatch, PolicyNetwork
from touchgoal.policies.perception.end_to_end import difference_images
from touchgoal.policies.perception.frozen_touch import TouchEmbedder
from touchgoal.policies.perception.proprioception import tare
from touchgoal.policies.perception.state_estimation import StateEstimator
from touchgoal.policies.regrasp import Regrasp
from touchgoal.policies.sight.average import KeyPoseAverage
from touchgoal.policies.sight.frozen_images import ImageEmbedder
from touchgoal.runtime.errors import RefusedError, UserError
from touchgoal.sim_envs.config import TASKS, EnvConfig, TaskName, task_name

Task = TypeVar("Task", bound=EnvConfig)

_USUAL_AGE = 0.1  # s; the oldest measurement is at most so old as deployed, see `DeploymentConfig`


@runtime_checkable
class Estimator(Protocol):
    """State estimator, or the simulator's ground truth in its place."""

    def estimate(
        self, observation: Observation, first: Observation
    ) -> dict[str, Float32[np.ndarray, " n"]]:
        """See StateEstimator."""
        ...


class LearnedPolicy(Planner):
    """A trained network that acts, one episode after the other.

    It executes `execution_horizon` ticks of each plan, slower if what it observes is late
    (`speed_for_age`). The same seed and observations give the same
    actions. Torch computes each plan on one thread: two are much slower when another process uses a
    core.

    Attributes:
        config: of the network.
        touch: embedder of the fingertips; None for a policy without touch.
        directory: where it was read from; None if it never was on disk.
        plan_ticks: control ticks from an observation to its plan. The next plan is requested that
            much earlier, and its actions for the ticks gone by are dropped.
        recovers: whether it tries again after the hand has lost its object, or closed on nothing.
        refuses_novelty: whether `plan` raises RefusedError once touch has been unlike the training
            for a second; set False to correct it there.
    """

    def __init__(
        self,
        network: PolicyNetwork,
        touch: TouchEmbedder | None,
        estimator: Estimator | None = None,
        plan_ticks: int = 0,
        directory: Path | None = None,
    ) -> None:
        """Get ready for an episode.

        UserError: the embedder is not the training's, an estimator is missing, or plans are too
        short for this delay.

        Args:
            touch: the embedder that the network was trained with.
            estimator: estimates the columns that only a simulator knows; None if there are none.
            plan_ticks: see above. On the first tick the arm stands still until the plan is there.
        """
        self.config = config = network.config
        if (touch.name if touch else "") != config.touch:
            raise UserError(
                f"the policy was trained with the touch encoder {config.touch or 'none'}, this is "
                f"{touch.name if touch else 'none'}: load the one that it was trained with"
            )
        if config.estimated and estimator is None:
            raise UserError(f"the policy acts on {config.estimated[0]}: give it a state estimator")
        self._network, self.touch, self._estimator = network, touch, estimator
        self._images = ImageEmbedder(config.images) if config.images else None
        self.plan_ticks, self.directory = plan_ticks, directory
        self.recovers = self._learned_estimator is not None
        self.refuses_novelty = True
        self._check_delay(plan_ticks)
        self.observation_horizon = config.observation_horizon
        self.execution_horizon, self.control_hz = config.execution_horizon, config.control_hz
        # the network's own observations, and those before them that the touch encoder looks back to
        self.history_ticks = config.observation_horizon + (touch.reach if touch else 0)
        self.reset()

    def __repr__(self) -> str:
        return f"LearnedPolicy({str(self.directory or '')!r}, task={self.config.task!r})"

    def reset(self, seed: int = 0) -> None:
        """Begin an episode, whose first observation is untouched; `seed` is that of the plans' noise."""
        self._generator = torch.Generator().manual_seed(seed)
        self.done = False
        self._begin({})
        self._regrasp, self.given_up = Regrasp(self.control_hz, self.execution_horizon), ""
        self._recent: list[Observation] = []
        self._todo: list[np.ndarray] = []  # actions of the present plan
        self._next: list[np.ndarray] = []  # actions of the plan that comes next

    def _begin(self, first: Observation) -> None:
        """Begin to observe, from an observation without contact."""
        self._first = first
        self._embedded: list[tuple[Observation, np.ndarray, np.ndarray]] = []
        self._maps: tuple[Observation, Tensor] | None = None  # the latest embedded camera images
        self._novel_plans = self._done_plans = 0  # in a row
        self._changes = 0  # of the gripper
        self._key_pose = KeyPoseAverage(self.execution_horizon / self.control_hz)
        self._width: float | None = None  # of the gripper, where the next plan begins, m

    def act(self, observation: Observation) -> Float32[np.ndarray, "8"]:
        """Return the action (`features.ACTION`) for the next tick."""
        horizon, first = self.execution_horizon, not self._recent
        before = self._recent or [observation] * self.history_ticks
        self._recent = [*before[1:], observation]
        if first:
            self._todo = list(self.plan(self._recent)[:horizon])
        self._begin_next_plan()
        if len(self._todo) == self.plan_ticks:
            actions = self.plan(self._recent)[self.plan_ticks : self.plan_ticks + horizon]
            self._next = list(actions)
            self._begin_next_plan()
        return self._todo.pop(0)

    def _begin_next_plan(self) -> None:
        """Start the next plan if the present one is done."""
        if not self._todo:
            self._todo, self._next = self._next, []

    def plan(self, history: Sequence[Observation], /) -> Float32[np.ndarray, "h 8"]:
        """Return actions, the first for the latest of `history_ticks` observations (oldest first).

        In an episode's first call the oldest observation is the untouched first one.
        """
        self.embed(history)
        estimator = self._learned_estimator
        if estimator and (other := self._second_try(history[-1], estimator.touches)) is not None:
            return other
        with one_thread():
            _, touch, state = zip(*self._embedded, strict=True)
            touch, state = (torch.from_numpy(np.stack(x)).float()[None] for x in (touch, state))
            images, maps = self._difference_images(history[-1]), self._feature_maps(history[-1])
            batch = ObservationBatch(touch, state, images, maps)
            self._refuse_novel(batch)
            plan = self._network.plan(batch, self._generator, self._width, self._key_pose)
            actions, done = plan.actions[0].numpy(), bool(plan.done[0])
            done &= self._changes >= self.config.gripper_changes
            self._done_plans = self._done_plans + 1 if done else 0
            if (end := self._network.end) is not None:
                actions[:, :-1] *= not (done and end.stands)
                self.done = (
                    self._done_plans * self.execution_horizon >= end.seconds * self.control_hz
                )
            # The last action of a plan comes a tick and `execution_horizon` ticks after its
            # observation. The whole motion is done where no age is known.
            reaction = (1 + self.execution_horizon) / self.control_hz
            age = history[-1].get(ft.AGE, np.zeros(1)).item()
            actions[:, :-1] *= speed_for_age(age, reaction)
            width = float(actions[self.execution_horizon - 1, -1])
            if self._width not in (None, width):
                self._key_pose.change_gripper()
                self._changes += 1
            self._width = width
            return actions

    def _second_try(
        self, observation: Observation, touches: bool
    ) -> Float32[np.ndarray, "h 8"] | None:
        """Return the way back after the hand closed on nothing, or lost its object; None: the policy acts."""
        first, ticks = self._first, self.config.prediction_horizon
        what = self._regrasp.next(observation, first, touches, self._width)
        if what == "look again":
            self._begin(observation)
            try:
                self.embed([observation] * self.history_ticks)
            except RefusedError as error:
                self._regrasp.give_up(str(error))
                what = "back"
        self.given_up = self._regrasp.given_up
        return self._regrasp.way_back(observation, first, ticks) if what == "back" else None

    def _refuse_novel(self, batch: ObservationBatch) -> None:
        """Raise RefusedError once touch has been unlike the training for a second of plans."""
        if not self.refuses_novelty:
            return
        novelty = self._network.novelty_of(batch)
        self._novel_plans = self._novel_plans + 1 if novelty > 1 else 0
        ticks = self._novel_plans * self.execution_horizon
        if ticks >= NOVEL_SECONDS * self.control_hz:
            raise RefusedError(
                f"for a second touch has been unlike all of the training ({novelty:.1f} times "
                "as far from it as accepted): look for what has changed since the recordings"
            )

    def embed(self, history: Sequence[Observation], /) -> None:
        """Embed observations before `plan` needs them: most of the work."""
        self._first = self._first or history[0]
        ends = range(len(history) - self.observation_horizon + 1, len(history) + 1)
        with one_thread():
            self._embedded = [(history[end - 1], *self._embed_tick(history[:end])) for end in ends]
            self._feature_maps(history[-1])

    def _embed_tick(self, history: Sequence[Observation]) -> tuple[np.ndarray, np.ndarray]:
        """Return the touch embedding (e,) and the proprioception (s,) of the latest tick."""
        observation = history[-1]
        for before, touch, state in self._embedded:
            if before is observation:
                return touch, state
        known = dict(observation)
        if self._estimator:
            known |= self._estimator.estimate(observation, self._first)
        if ft.WRENCH in self.config.proprioception:
            known[ft.WRENCH] = tare(observation[ft.WRENCH], self._first[ft.WRENCH])
        state = np.concatenate([known[key] for key in self.config.proprioception])
        return self._embed_touch(history), state

    def _embed_touch(self, history: Sequence[Observation]) -> Float32[np.ndarray, " e"]:
        if self.touch is None:
            return np.empty(0, np.float32)
        return self.touch.embed_tick(history, self._first)

    def _feature_maps(self, observation: Observation) -> Float16[Tensor, "1 k c y x"] | None:
        """Return the maps of the camera images; those of the latest observation are kept."""
        if self._images is None:
            return None
        if self._maps is None or self._maps[0] is not observation:
            maps = torch.from_numpy(self._images.embed_tick(observation))[None]
            self._maps = observation, maps
        return self._maps[1]

    def _difference_images(self, observation: Observation) -> UInt8[Tensor, "1 k h w 3"] | None:
        if self.config.end_to_end is None:
            return None
        pairs = [(observation[k], self._first[k]) for k in ft.TACTILE]
        size = self.config.end_to_end.size
        images = [difference_images(image[None], first, size) for image, first in pairs]
        return torch.from_numpy(np.stack(images, 1))

    def env_config(self, task: Task | None = None, name: str = "") -> Task:
        """Return a task's options with the images that the policy reads, and no others.

        Default: the options of the policy's task, with its sensor. `name` is the task's, where it
        is not the simulated one's. UserError: the policy cannot act in the task.
        """
        config = self.config
        if task is None:
            if config.task not in TASKS:
                known = f"is for {config.task!r}" if config.task else "does not name its task"
                raise UserError(f"{self._name} {known}, which no simulator knows: give a config")
            task = cast(Task, TASKS[cast(TaskName, config.task)](control_hz=config.control_hz))
            task = replace(task, sensor=config.sensor or task.sensor)
        self._check_task(task, name or task_name(task))
        estimator = self._learned_estimator
        reads_touch = config.touch_dim > 0 or config.end_to_end is not None or estimator is not None
        if config.images:
            keys, size = config.images.cameras, config.images.size
        elif estimator:
            keys, size = estimator.cameras, estimator.camera_size
        else:
            return replace(task, tactile=reads_touch, cameras=())
        cameras = tuple(key.removeprefix(ft.IMAGE_PREFIX) for key in keys)
        return replace(task, tactile=reads_touch, cameras=cameras, camera_size=size)

    @property
    def target(self) -> str:
        """The object to pick up, in words; "" if it is the only one."""
        return self._learned_estimator.target if self._learned_estimator else ""

    @property
    def _learned_estimator(self) -> StateEstimator | None:
        """The estimator unless the simulator's ground truth stands in its place."""
        return self._estimator if isinstance(self._estimator, StateEstimator) else None

    @property
    def _name(self) -> str:
        return f"the policy in {self.directory}" if self.directory else "the policy"

    def _check_task(self, task: EnvConfig, name: str) -> None:
        """Raise UserError if the policy cannot act in the task of this name."""
        config = self.config
        if config.task and config.task != name:
            hint = f"add --task {config.task}, or choose another policy"
            if config.task not in TASKS:
                hint = f'run it by touchgoal deploy CELL --task "{config.task}"'
            raise UserError(f"{self._name} was trained for {config.task}, not for {name}: {hint}")
        if task.arm != "fr3":
            raise UserError(
                f"{self._name} commands the seven joints of an FR3, the task has a {task.arm}: "
                "leave out --env.arm, or choose the expert"
            )
        if task.control_hz != config.control_hz:
            raise UserError(
                f"{self._name} acts at {config.control_hz} Hz, not {task.control_hz}: leave out "
                "--env.control-hz, or train a policy at that rate"
            )
        sensor = find_sensor(task.sensor).name
        trained = {config.sensor, self.touch and self.touch.sensor}
        for other in trained - {"", None, sensor}:
            raise UserError(
                f"{self._name} was trained with the sensor {other}, the task has {sensor}: choose "
                f"{other} (--env.sensor {other}), or another policy"
            )
        self._check_delay(max(task.deployment.plan_ticks) if task.as_deployed else 0)

    def _check_delay(self, plan_ticks: int) -> None:
        """Raise UserError if plans are too short for this delay."""
        config = self.config
        spare = config.prediction_horizon - config.execution_horizon
        if not 0 <= plan_ticks <= min(spare, config.execution_horizon):
            raise UserError(
                f"a plan of {config.prediction_horizon} ticks, {config.execution_horizon} of them "
                f"done, cannot come {plan_ticks} ticks late: change execution_horizon"
            )


def speed_for_age(age: float, reaction: float) -> float:
    """Return the share of its speed at which a hand goes no further before it reacts than usual.

    Args:
        age: of the oldest measurement that is observed, s.
        reaction: time from the observation to the last action that follows from it, s.
    """
    return (_USUAL_AGE + reaction) / (max(age, _USUAL_AGE) + reaction)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread, and on as many as before afterwards."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
