"""An environment's arm as it is deployed: what lies between policy and arm, a millisecond at a time.

Joint changes pass deploy's lag, the safety layer and the 1 kHz tracker, as on the wire; what the
policy sees is as old as it is there. The twin's own arm (`twin/cell.py`) follows its set-points as
this one does.
"""

from collections import deque
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, Int

from touchgoal.control import features as ft
from touchgoal.control.motion.servo_lag import SERVO_DAMPING, ServoLag
from touchgoal.control.motion.tracker import Tracker
from touchgoal.control.safety.action_filter import ActionFilter, Measurements
from touchgoal.control.safety.task_ceilings import TASK_FORCES
from touchgoal.sim_envs.cell.deployed_hand import DeployedHand
from touchgoal.sim_envs.cell.estimated_wrench import EstimatedWrench
from touchgoal.sim_envs.config import DeploymentConfig

_DT = 1e-3  # s
_WRENCH_PERIOD = 10  # ms between readings of the force on the hand
_AHEAD = 10  # ticks for which delays are drawn beyond an episode's end

Joints = Float[np.ndarray, " n"]


class _Drive(Protocol):
    """How joint changes become set-points of the servo."""

    def accept(self, delta: Joints) -> Joints:
        """The target (rad) that a tick's joint change (rad) leads to."""
        ...

    def set_target(self, target: Joints) -> None:
        """A target arrives at the arm."""
        ...

    def step(self) -> Joints:
        """The servo's set-point (rad) of the next millisecond."""
        ...

    @property
    def command(self) -> Joints:
        """Where all that was wanted so far leads to, rad."""
        ...


class _DirectDrive:
    """As without a deployment: in a straight line to each target, in a tick."""

    def __init__(self, start: Joints, limits: Float[np.ndarray, "n 2"], ticks: int) -> None:
        self.command, self._limits, self._ticks = start, limits, ticks
        self._now = self._target = start
        self._left = 0

    def accept(self, delta: Joints) -> Joints:
        self.command = np.clip(self.command + delta, self._limits[:, 0], self._limits[:, 1])
        return self.command

    def set_target(self, target: Joints) -> None:
        self._target, self._left = target, self._ticks

    def step(self) -> Joints:
        if self._left:
            self._now = self._now + (self._target - self._now) / self._left
            self._left -= 1
        return self._now


class _TrackedDrive:
    """As deployed: lag, safety layer, tracker, and an arm that follows its set-point at once."""

    def __init__(self, start: Joints, safety: ActionFilter) -> None:
        self._safety, self._state = safety, safety.start(start)
        self._tracker = Tracker(
            safety.limits.interface, safety.limits.policy.velocity, safety.dt, _DT
        )
        self._track = self._tracker.start(start)
        self._lag = ServoLag(safety.limits, safety.dt)

    @property
    def command(self) -> Joints:
        return self._state.q + self._lag.remaining

    def accept(self, delta: Joints) -> Joints:
        step = self._lag.update(delta)
        self._state = self._safety.filter_action(self._state, step, all_well(self._state.q))
        return self._state.q

    def set_target(self, target: Joints) -> None:
        self._track = self._tracker.set_target(self._track, target)

    def step(self) -> Joints:
        before = self._track.q
        self._track = self._tracker.step(self._track)
        return self._track.q + SERVO_DAMPING * (self._track.q - before) / _DT


class DeployedArm:
    """One episode, from where the arm rests.

    Attributes:
        plan_ticks: by which a learned policy's plans come late.
        contacts: of the pads, when the pictures of the last observation were taken.
        stopped: whether the force on the hand, as the policy saw it, was above the task's ceiling.
    """

    def __init__(self, env: Any, between: DeploymentConfig, rng: np.random.Generator) -> None:
        assert between.plan_ticks is not None
        self._env = env
        hz = env.config.control_hz
        self._tick_ms = round(1000 / hz)
        start = env.command.copy()
        n = env.n_joints
        if between.tracker:
            # Set-points with feed-forward reach beyond the joints' range; the tracker keeps to it.
            env.model.actuator_ctrllimited[:n] = 0
            self._drive: _Drive = _TrackedDrive(start, ActionFilter(env.robot, hz))
        else:
            limits = env.model.actuator_ctrlrange[:n]
            self._drive = _DirectDrive(start, limits, self._tick_ms)
        self._hand = DeployedHand(env, rng) if between.franka_hand else None
        self._wrench = EstimatedWrench(rng) if between.estimated_wrench else None
        self.plan_ticks = int(rng.choice(between.plan_ticks))
        ticks = round(env.config.max_seconds * hz) + _AHEAD
        jitter = rng.uniform(*_range(between.jitter))
        self._state_at = _read_times(rng, between.state_delay, jitter, ticks, self._tick_ms)
        period = 1000 / (between.picture_rate or 1000.0)
        self._picture_at = _read_times(
            rng, between.picture_delay, jitter, ticks, self._tick_ms, period
        )
        delays = _delays(rng, between.command_delay, jitter, ticks)
        # A command never overtakes the one before it.
        self._arrives = np.maximum.accumulate(np.arange(ticks) * self._tick_ms + delays)
        self._steps = round(_DT / env.model.opt.timestep)
        self._ms, self._tick = 0, 0
        self._commands: deque[tuple[int, Joints, float]] = deque()
        self._width = env.width_target()
        self._states = {0: self._read_state()}
        self._pictures = {0: (env.take_pictures(), env.pad_contacts())}
        self.contacts = env.pad_contacts()
        forces = TASK_FORCES.get(env.task) if between.force_ceiling else None
        self._ceiling = forces.force_ceiling if forces else np.inf
        self.stopped = False

    def run_tick(self, delta: Joints, width: float) -> None:
        """A control tick of physics, with what the policy has just answered."""
        env = self._env
        target = self._drive.accept(np.asarray(delta, np.float64))
        env.command = self._drive.command
        self._commands.append((int(self._arrives[self._tick]), target, float(width)))
        self._tick += 1
        end = self._ms + self._tick_ms
        reads = self._moments(self._state_at, end)
        shots = self._moments(self._picture_at, end)
        while self._ms < end:
            while self._commands and self._commands[0][0] <= self._ms:
                _, target, self._width = self._commands.popleft()
                self._drive.set_target(target)
            width = self._hand.step(self._ms, self._width) if self._hand else self._width
            env.step_physics(self._drive.step(), width, env.robot.tool.speed, self._steps)
            self._ms += 1
            self._sense(self._ms in reads, self._ms in shots)
        env.update_contacts()

    def observation(self) -> dict[str, np.ndarray]:
        """What the policy sees after the last tick."""
        read_at, shot_at = int(self._state_at[self._tick]), int(self._picture_at[self._tick])
        self._states = _since(self._states, read_at)
        self._pictures = _since(self._pictures, shot_at)
        pictures, self.contacts = self._pictures[shot_at]
        state = self._states[read_at]
        self.stopped |= bool(np.linalg.norm(state[ft.WRENCH][:3]) > self._ceiling)
        return {**state, **pictures}

    def _sense(self, read: bool, shoot: bool) -> None:
        """Measure and take pictures, where this millisecond is the time for it."""
        env = self._env
        feel = self._wrench is not None and self._ms % _WRENCH_PERIOD == 0
        if not (read or shoot or feel):
            return
        env.update_contacts()
        if feel and self._wrench:
            self._wrench.update(env.external_wrench(), _WRENCH_PERIOD * _DT)
        if read:
            self._states[self._ms] = self._read_state()
        if shoot:
            self._pictures[self._ms] = env.take_pictures(), env.pad_contacts()

    def _read_state(self) -> dict[str, np.ndarray]:
        state = self._env.read_proprioception()
        if self._wrench:
            state[ft.WRENCH] = self._wrench.read().astype(np.float32)
        if self._hand:
            state[ft.STATE][-1] = self._hand.width
        return state

    def _moments(self, at: Int[np.ndarray, " t"], end: int) -> set[int]:
        """The milliseconds of the coming tick at which something is read."""
        return set(at[(at > self._ms) & (at <= end)].tolist())


def all_well(q: Joints) -> Measurements:
    """So that the safety layer clamps, as it does on the wire, and never stops: tasks do that here."""
    return Measurements(
        q=q,
        force=np.zeros(3),
        torque=np.zeros(q.size),
        indentation=np.zeros(2),
        observation_age=0.0,
        action_age=0.0,
        state_age=0.0,
        gripper_age=0.0,
    )


def _range(given: tuple[float, float] | None) -> tuple[float, float]:
    assert given is not None, "a config that is resolved, see EnvConfig.resolved_deployment"
    return given


def _delays(
    rng: np.random.Generator, delay: tuple[float, float] | None, jitter: float, ticks: int
) -> Int[np.ndarray, " t"]:
    """ms, of each tick: one delay for the episode, and what varies."""
    drawn = rng.uniform(*_range(delay)) + rng.uniform(0, 1, ticks) * jitter
    return np.round(drawn * 1000).astype(int)


def _read_times(
    rng: np.random.Generator,
    delay: tuple[float, float] | None,
    jitter: float,
    ticks: int,
    tick_ms: int,
    period: float = 1.0,
) -> Int[np.ndarray, " t"]:
    """When (ms) what is seen at each tick was measured, every `period` ms.

    Never before the start, and in the order of time.
    """
    at = np.arange(ticks) * tick_ms - _delays(rng, delay, jitter, ticks)
    if period > 1:
        phase = rng.uniform(0, period)
        at = (np.floor((at - phase) / period) * period + phase).astype(int)
    return np.maximum.accumulate(np.maximum(at, 0))


def _since(kept: dict, moment: int) -> dict:
    return {at: value for at, value in kept.items() if at >= moment}
