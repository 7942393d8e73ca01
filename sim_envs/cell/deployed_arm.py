"""The environment's arm as `deploy` drives it, a millisecond at a time.

Joint changes pass its lag, safety layer and 1 kHz tracker; observations are as old as on the wire.
"""

from collections import deque
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int

from touchgoal.control import features as ft
from touchgoal.control.grippers.hand_commands import CLOSED_WIDTH, PERIOD, HandCommands, LastCommand
from touchgoal.control.motion.tracker import SERVO_DAMPING, ServoLag, Tracker
from touchgoal.control.safety.action_filter import ActionFilter, Measurements
from touchgoal.sim_envs.cell.deployment import DeploymentConfig
from touchgoal.sim_envs.cell.estimated_wrench import EstimatedWrench
from touchgoal.sim_envs.cell.hardware import SimulatedHardware

_DT = 1e-3  # s
_WRENCH_PERIOD = 10  # ms between estimates of the force on the hand
_FORCE_PERIOD = 2  # ms between looks at the true force
_HAND_PERIOD = round(1000 * PERIOD)  # ms
_ARRIVED = 1e-3  # m
_STILL = 2e-4  # m; fingers that move less between two looks have stopped
_LEAST = 2  # looks before a command can end
_AHEAD = 10  # ticks for which delays are drawn beyond an episode's end
_REST = 10.0  # s for which an arm may rest after that; then delays are the last tick's

Joints = Float[np.ndarray, " n"]
Value = TypeVar("Value")


class _TrackedDrive:
    """Set-points as `deploy` makes them, by lag, safety layer and tracker."""

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
        """Return the target (rad) of a tick's joint change (rad)."""
        step = self._lag.update(delta)
        at_rest = measurements_at_rest(self._state.q)
        self._state = self._safety.filter_action(self._state, step, at_rest)
        return self._state.q

    def set_target(self, target: Joints) -> None:
        self._track = self._tracker.set_target(self._track, target)

    def step(self) -> Joints:
        """Return the servo's set-point (rad) of the next millisecond."""
        before = self._track.q
        self._track = self._tracker.step(self._track)
        return self._track.q + SERVO_DAMPING * (self._track.q - before) / _DT


class DeployedHand:
    """A Franka Hand behind its driver in one episode, open and at rest at first."""

    def __init__(
        self, read_width: Callable[[], float], max_width: float, rng: np.random.Generator
    ) -> None:
        """Take what reads the fingers' width (m), and their largest width (m)."""
        self._read_width, self._max_width = read_width, max_width
        self._phase = int(rng.integers(_HAND_PERIOD))
        self._goal = self.width = read_width()  # width: last reading, m
        self._commands = HandCommands(self.width)
        self._last: LastCommand = "arrived"
        self._grasps, self._age = False, 0

    def step(self, ms: int, target_width: float) -> float:
        """Return the width (m) that the fingers go to now, given the latest target."""
        if ms % _HAND_PERIOD == self._phase:
            self._look(target_width)
        return self._goal

    def _look(self, target_width: float) -> None:
        before, self.width = self.width, self._read_width()
        self._age += 1
        if self._last == "runs" and self._age > _LEAST:
            if abs(self.width - self._goal) < _ARRIVED:
                self._last = "arrived"
            elif abs(self.width - before) < _STILL:
                self._last = "stopped short"
        grasped = self._grasps and self._last != "runs" and self.width > CLOSED_WIDTH
        target = min(max(target_width, 0.0), self._max_width)
        command = self._commands.next(target, self.width, grasped, self._last)
        if command is not None:
            self._grasps = command.grasp
            self._goal = 0.0 if command.grasp else command.width
            self._last, self._age = "runs", 0


class DeployedArm:
    """The environment's arm as deployed, for one episode that begins at rest."""

    def __init__(
        self,
        hardware: SimulatedHardware,
        start: Joints,
        deployment: DeploymentConfig,
        rng: np.random.Generator,
    ) -> None:
        """Draw the delays of an episode.

        Args:
            hardware: arm, hand and sensors.
            start: commanded joints at first, rad.
            deployment: ranges of the delays.
            rng: draws delays and errors.
        """
        self._hardware = hardware
        hz = hardware.config.control_hz
        self._tick_ms = round(1000 / hz)
        hardware.release_setpoints()
        self._drive = _TrackedDrive(start, ActionFilter(hardware.robot, hz))
        self._hand = DeployedHand(hardware.width, hardware.robot.tool.stroke[1], rng)
        self._wrench = EstimatedWrench(rng)
        self.plan_ticks = int(rng.choice(deployment.plan_ticks))  # by which learned plans are late
        ticks = round(hardware.config.max_seconds * hz) + _AHEAD
        jitter = rng.uniform(*deployment.jitter)
        self._state_at = _read_times(rng, deployment.state_delay, jitter, ticks, self._tick_ms)
        taken = rng, deployment.image_delay, jitter, ticks, self._tick_ms
        self._image_at = _read_times(*taken, 1000 / deployment.image_rate)
        delays = _delays(rng, deployment.command_delay, jitter, ticks)
        # A command never overtakes the one before it.
        self._arrives = np.maximum.accumulate(np.arange(ticks) * self._tick_ms + delays)
        after = self._tick_ms * np.arange(1, round((_REST + hardware.config.rest) * hz) + 1)
        self._state_at, self._image_at, self._arrives = (
            np.append(at, at[-1] + after) for at in (self._state_at, self._image_at, self._arrives)
        )
        self._steps = round(_DT / hardware.model.opt.timestep)
        self._ms, self._tick = 0, 0
        self._commands: deque[tuple[int, Joints, float]] = deque()
        self._width = hardware.width_target()
        self._states = {0: self._read_state()}
        self._images = {0: (hardware.take_images(), hardware.pad_contacts())}
        self.contacts = hardware.pad_contacts()  # at the time of the last observation's images

    def run_tick(self, delta: Joints, width: float) -> Joints:
        """Run a control tick with the policy's action; end it where the force is too high.

        Return the commanded joints, rad.
        """
        hardware = self._hardware
        target = self._drive.accept(np.asarray(delta, np.float64))
        self._commands.append((int(self._arrives[self._tick]), target, float(width)))
        self._tick += 1
        end = self._ms + self._tick_ms
        reads = self._moments(self._state_at, end)
        shots = self._moments(self._image_at, end)
        too_high, speed = False, hardware.robot.tool.speed
        while self._ms < end and not too_high:
            while self._commands and self._commands[0][0] <= self._ms:
                _, target, self._width = self._commands.popleft()
                self._drive.set_target(target)
            width = self._hand.step(self._ms, self._width)
            hardware.step_physics(self._drive.step(), width, speed, self._steps)
            self._ms += 1
            self._measure(self._ms in reads, self._ms in shots)
            if self._ms % _FORCE_PERIOD == 0:
                too_high = hardware.monitor_force(_FORCE_PERIOD * _DT)
        hardware.update_contacts()
        return self._drive.command

    def observation(self) -> dict[str, np.ndarray]:
        """Return the policy's observation after the last tick."""
        read, shot = int(self._state_at[self._tick]), int(self._image_at[self._tick])
        self._states, state = _latest(self._states, read)
        self._images, (images, self.contacts) = _latest(self._images, shot)
        age = (self._ms - (min(read, shot) if images else read)) * _DT
        return {**state, **images, ft.AGE: np.array([age], np.float32)}

    def _measure(self, read: bool, shoot: bool) -> None:
        hardware = self._hardware
        estimate = self._ms % _WRENCH_PERIOD == 0
        if not (read or shoot or estimate):
            return
        hardware.update_contacts()
        if estimate:
            self._wrench.update(hardware.external_wrench(), _WRENCH_PERIOD * _DT)
        if read:
            self._states[self._ms] = self._read_state()
        if shoot:
            self._images[self._ms] = hardware.take_images(), hardware.pad_contacts()

    def _read_state(self) -> dict[str, np.ndarray]:
        state = self._hardware.read_proprioception()
        state[ft.WRENCH] = self._wrench.read().astype(np.float32)
        state[ft.STATE][-1] = self._hand.width
        return state

    def _moments(self, at: Int[np.ndarray, " t"], end: int) -> set[int]:
        """Return the milliseconds of the coming tick at which something is due."""
        return set(at[(at > self._ms) & (at <= end)].tolist())


def measurements_at_rest(q: Joints) -> Measurements:
    """Return measurements at which the safety layer never stops: the environment does that."""
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


def _delays(
    rng: np.random.Generator, delay: tuple[float, float], jitter: float, ticks: int
) -> Int[np.ndarray, " t"]:
    """Draw each tick's delay (ms): one delay for the episode, plus jitter."""
    drawn = rng.uniform(*delay) + rng.uniform(0, 1, ticks) * jitter
    return np.round(drawn * 1000).astype(int)


def _read_times(
    rng: np.random.Generator,
    delay: tuple[float, float],
    jitter: float,
    ticks: int,
    tick_ms: int,
    period: float = 1.0,
) -> Int[np.ndarray, " t"]:
    """Draw when (ms), in order of time, each tick's measurement was taken, every `period` ms."""
    at = np.arange(ticks) * tick_ms - _delays(rng, delay, jitter, ticks)
    if period > 1:
        phase = rng.uniform(0, period)
        at = (np.floor((at - phase) / period) * period + phase).astype(int)
    return np.maximum.accumulate(np.maximum(at, 0))


def _latest(values: dict[int, Value], moment: int) -> tuple[dict[int, Value], Value]:
    """Drop what is older than the latest value at `moment`; return the rest and that value."""
    latest = max(at for at in values if at <= moment)
    return {at: value for at, value in values.items() if at >= latest}, values[latest]
