"""Common part of the Franka's and the UR's drivers: it streams targets and holds the first fault.

The policy's targets (10 to 20 Hz) go through the tracker, so the stream stays inside the
interface's limits and ends at rest at the last target.
"""

import time
from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from touchgoal.control import features as ft
from touchgoal.control.arms.driver_process import NEVER, DriverProcess, call_timeout, error_line
from touchgoal.control.interfaces import STOPPED_ON_REQUEST, ArmReading, DriverError, Joints
from touchgoal.control.motion.arm_models import JointLimits
from touchgoal.control.motion.tracker import Tracker, TrackerState
from touchgoal.control.safety.limits import RobotLimits
from touchgoal.runtime.errors import UserError

_MAX_CATCH_UP = 4  # periods that a late tick makes up for at once
_BRAKING = 1.5  # s for coming to rest on closing
_REST, _LOOK = 0.01, 0.05  # rad/s, mean over so many s, below which the arm is at rest


@dataclass(frozen=True)
class ArmConfig:
    """Address of an arm's controller, and rate of its driver."""

    address: str
    robot: RobotLimits  # geometry, tool and limits
    rate: float  # of the outgoing stream, Hz
    # s without news after which the controller is lost; a loaded simulator needs more
    state_timeout: float
    lock_step: bool = False  # the twin advances only when `advance` is called


class ArmClient(ABC):
    """A vendor's client behind five methods, in the driver's process; it ticks at `config.rate`.

    When the link is lost, or the controller is silent, the process ends: no library reconnects
    unwatched, and a controller stops the arm of a dead client.
    """

    _commanded: Joints  # the controller's own present command, rad; `_measure` sets it

    def __init__(self, config: ArmConfig, recover: bool) -> None:
        self.config, self._stream_period = config, 1 / config.rate
        self.period = NEVER if config.lock_step else self._stream_period
        self._state: TrackerState | None = None
        self._twin_time: float | None = None
        # Compile (or load) a tracker's first step now, before a controller waits for it.
        self._make_tracker(config.robot.interface)
        self._tracker = self._make_tracker(self._connect(recover))
        self._clock, self._stamp = -1.0, time.monotonic()
        self._reading = self._measure()
        self._refusal = self._reading.fault
        self._ticked, self._streamed, self._streams = time.monotonic(), 0.0, False

    def _make_tracker(self, limits: JointLimits) -> Tracker:
        speed = self.config.robot.policy.velocity
        return Tracker(limits, speed, 1 / ft.CONTROL_HZ, self._stream_period)

    @abstractmethod
    def _connect(self, recover: bool) -> JointLimits:
        """Connect, clear errors if a person asked for that, and return the stream's limits."""

    @abstractmethod
    def _measure(self) -> ArmReading:
        """Return the newest state, stamped by `_stamped`. It and `_send` raise when the link is lost."""

    @abstractmethod
    def _send(self, q: Joints, velocity: Joints) -> None:
        """Stream one command: joint positions (rad) and their velocity (rad/s)."""

    @abstractmethod
    def _halt(self) -> None:
        """Brake by the controller's own means; an exception is ignored."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Disconnect; an exception is ignored."""

    def read(self) -> ArmReading:
        """Return the state as of the last tick."""
        return replace(self._reading, fault=self._refusal)

    def command(self, q: Joints) -> None:
        """Set a new target (rad)."""
        if self._refusal:
            raise DriverError(f"no command is taken: {self._refusal}")
        limits = self.config.robot.interface
        if not (np.isfinite(q).all() and (q >= limits.lower).all() and (q <= limits.upper).all()):
            raise UserError(f"the target {np.round(q, 3).tolist()} rad is beyond a joint's range")
        if self._state is None:
            self._state = self._tracker.start(self._commanded)
            self._streamed = self._reading.time
        self._state = self._tracker.set_target(self._state, q)

    def stop(self) -> None:
        """Brake, and take no command any more."""
        self._refuse_from_now_on(f"{STOPPED_ON_REQUEST}; recover the arm to go on")

    def tick(self) -> None:
        """Read the state and stream the next command, by the controller's clock."""
        now = time.monotonic()
        punctual = now - self._ticked < self.config.state_timeout / 2
        self._ticked = now
        self._reading = self._measure()
        if self._twin_time is not None:
            self._reading = replace(self._reading, time=self._twin_time)
        if punctual and now - self._reading.stamp > self.config.state_timeout:
            raise DriverError(
                f"no state for {1e3 * self.config.state_timeout:.0f} ms: check power and cable, then recover"
            )
        if self._reading.fault:
            self._refuse_from_now_on(self._reading.fault)
        if self._state is None:
            return
        time_, before = self._reading.time, self._state.q
        period = self._stream_period
        periods = min(round((time_ - self._streamed) / period), _MAX_CATCH_UP)
        if periods < 1:
            return
        self._streamed = max(self._streamed + periods * period, time_ - period)
        for _ in range(periods):
            self._state = self._tracker.step(self._state)
        self._send(self._state.q, (self._state.q - before) / (periods * period))
        self._streams = True

    def advance(self, time: float) -> bool:
        """Tick at a twin's time (s); return whether the stream drives the arm.

        A lost link is the arm's fault from then on.
        """
        self._twin_time = time
        try:
            self.tick()
        except Exception as error:  # of any client library
            self._refuse_from_now_on(error_line(error))
        return self._streams

    def close(self) -> None:
        """Bring the arm to rest and disconnect."""
        self._refuse_from_now_on("closed")
        end = time.monotonic() + _BRAKING
        with suppress(Exception):
            while time.monotonic() < end:
                before = self._reading.q
                time.sleep(_LOOK)
                self.tick()
                if np.abs(self._reading.q - before).max() < _REST * _LOOK:
                    break
        with suppress(Exception):
            self._disconnect()

    def _refuse_from_now_on(self, reason: str) -> None:
        """Brake; the first reason stays."""
        self._state, self._streams = None, False
        if not self._refusal:
            self._refusal = reason
            with suppress(Exception):
                self._halt()

    def _stamped(self, clock: float) -> float:
        """Return the stamp of a measurement: now if the controller's clock advanced, else as before."""
        if clock != self._clock:
            self._clock, self._stamp = clock, time.monotonic()
        return self._stamp


class ArmProcess:
    """Arm over an ArmClient in a child process."""

    def __init__(self, client: type[ArmClient], config: ArmConfig, recover: bool = False) -> None:
        timeout = call_timeout(config.lock_step)
        self._process = DriverProcess(client, config, recover, call_timeout=timeout)
        self._last: ArmReading = self._process.call("read")

    def read(self) -> ArmReading:
        """See Arm. A lost arm keeps its last reading, with the reason as its fault."""
        try:
            self._last = self._process.call("read")
        except DriverError as error:
            self._last = replace(self._last, fault=str(error))
        return self._last

    def command(self, q: Joints) -> None:
        """See Arm."""
        self._process.call("command", q)

    def advance(self, time: float) -> bool:
        """See ArmClient; False for a lost arm."""
        try:
            return self._process.call("advance", time)
        except DriverError:
            return False

    def stop(self) -> None:
        """See Arm. A lost arm is stopped by its controller."""
        if self._process.alive:
            with suppress(DriverError):
                self._process.call("stop")

    def close(self) -> None:
        """See Arm."""
        self._process.close()


def shift_wrench(
    wrench: Float[np.ndarray, "6"], origin: Float[np.ndarray, "3"], point: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "6"]:
    """Return a wrench (N, Nm) about `origin` as a wrench about `point` (m), all in one frame."""
    return np.concatenate([wrench[:3], wrench[3:] + np.cross(origin - point, wrench[:3])])
