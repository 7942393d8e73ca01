"""Interfaces of arm, gripper, camera, fingertip, load cell, policy and actor.

Every reading is a frozen snapshot with `stamp`, the monotonic time (s) at which its content was
new: a driver without news returns the old reading, so that its age shows. `read` and `command` wait
for hardware no longer than a time-out; a device that is broken for good raises DriverError.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32

from touchgoal.control import features as ft
from touchgoal.control.arrays import Image
from touchgoal.control.features import Observation
from touchgoal.control.motion.arm_models import Joints
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.runtime.errors import UserError

STOPPED_ON_REQUEST = "stopped on request"
"""Prefix of the fault message of an arm that was stopped on request."""


class DriverError(UserError):
    """A device failed; one line says what happened and what a person can do."""


@dataclass(frozen=True)
class ArmReading:
    """An arm's state."""

    q: Joints  #: positions, rad
    velocity: Joints  #: of the joints, rad/s
    #: force (N) and torque (Nm) of the environment on the robot at the TCP, base frame; NaN where the
    #: arm measures none, as an FR3 near a singularity
    wrench: Float[np.ndarray, "6"]
    torque: Joints  #: external, on each joint, Nm
    fault: str  #: why the arm refuses commands until a person recovers it; empty if it takes them
    stamp: float  #: s, when the controller's clock last advanced
    time: float  #: s, that clock
    #: m, tool centre point (with this package's tool) by the controller's own kinematics, base frame;
    #: None where there is no such controller
    tcp: Float[np.ndarray, "3"] | None = None


@dataclass(frozen=True)
class GripperReading:
    """A parallel gripper's state: width between the fingertips (m), whether it holds something."""

    width: float
    grasped: bool
    fault: str
    stamp: float


@dataclass(frozen=True)
class Frame:
    """An RGB image."""

    image: Image
    sequence: int  #: number of frames taken, unread ones included
    stamp: float  #: s, right after the grab; for a frozen camera, when its image last changed


@dataclass(frozen=True)
class LoadReading:
    """Force (N) measured by a load cell; `rejected` counts refused lines."""

    force: float
    rejected: int
    stamp: float


@dataclass(frozen=True)
class CostReading:
    """Distance to the goal at one tick, which was handed over at `stamp`."""

    cost: float
    stamp: float
    verdict: Literal["", "success", "failure", "unsure"] = ""  # of a judge; "": none, or not asked
    reasons: tuple[str, ...] = ()  # of the verdict, for people
    done: bool = False  # whether the judge says so lastingly, while the arm rests: it ends the run


@runtime_checkable
class Arm(Protocol):
    """A position-controlled arm.

    `command` takes joint positions (rad) to be reached one control period from now. Without a new
    one the arm comes to rest at the last. After `stop` or a fault it refuses commands; only a new
    connection ends that.
    """

    def read(self) -> ArmReading:
        """Return the newest state."""
        ...

    def command(self, q: Joints) -> None:
        """Move on to `q` (rad); DriverError if stopped or at fault, UserError if beyond the range."""

    def stop(self) -> None:
        """Brake as fast as the limits allow, and stay; returns at once."""

    def close(self) -> None:
        """Bring the arm to rest, then disconnect."""


@runtime_checkable
class Gripper(Protocol):
    """A parallel gripper; `command` closes or opens it to a width (m), or onto an object."""

    def read(self) -> GripperReading:
        """Return the newest state."""
        ...

    def command(self, width: float) -> None:
        """Go on to a width (m), clipped to the stroke; returns at once.

        DriverError at fault or after `stop`, which only a new connection ends.
        """

    def stop(self, release_to: float | None = None) -> None:
        """Stop moving and take no command any more; what is held stays held.

        With `release_to`, let go instead: open to this width (m) and stay there.
        """

    def close(self) -> None:
        """Disconnect; the fingers stay."""


@runtime_checkable
class Camera(Protocol):
    """A stream of images; only the newest counts."""

    @property
    def problem(self) -> str:
        """Problem for a person to know, such as lost or frozen; empty if none."""
        ...

    def read(self) -> Frame:
        """Return the newest frame; wait for the first, DriverError if none comes."""
        ...

    def close(self) -> None:
        """Release the device."""


@runtime_checkable
class TactileSensor(Camera, Protocol):
    """A fingertip camera whose frames have the shape of its sensor model's."""

    @property
    def model(self) -> SensorModel:
        """Model of the sensor."""
        ...


@runtime_checkable
class LoadCell(Protocol):
    """A one-axis force sensor."""

    def read(self) -> LoadReading:
        """Return the newest accepted line; wait for the first, DriverError if none comes."""
        ...

    def close(self) -> None:
        """Release the port."""


@runtime_checkable
class Policy(Protocol):
    """A policy as a user writes it: two methods."""

    def reset(self) -> None:
        """Begin an episode."""

    def act(self, observation: Observation) -> np.ndarray:
        """Return the action of the next tick: joint change (rad, one a joint), gripper's width (m).

        Keys and units of the observation: `control/features.py`.
        """
        ...


@runtime_checkable
class Cost(Protocol):
    """Measures how far ticks are from a goal, beside the loop."""

    def begin(self, observation: Observation) -> None:
        """Begin a run, and measure its state before the first tick; returns at once."""

    def hand_over(self, observation: Observation) -> None:
        """Take the next tick; returns at once."""

    def read(self) -> CostReading:
        """Return the newest cost; wait for the first, DriverError with the reason if none comes."""
        ...

    def judge(self) -> CostReading:
        """Measure the newest tick as the run's end; the verdict is "" without a judge."""
        ...


class Actor:
    """Source of actions in a control loop or an environment; on an arm `act` takes less than a tick."""

    done = False  #: whether its plan has ended
    given_up = ""  #: why it will not go on: the task has failed
    recovers = False  #: whether it goes on where the hand has lost its object
    action_age = 0.0  #: s for which it has had no new answer

    def start(self, observation: Observation) -> None:
        """Prepare for the first tick, while the arm is still at rest."""

    def act(self, observation: Observation) -> Float[np.ndarray, " n"]:
        """Return the joint change (rad) of this tick and the gripper's target width (m)."""
        raise NotImplementedError

    def close(self) -> None:
        """End what `start` began."""


class Planner(Actor):
    """Policy that plans several ticks from one observation; by default a single tick."""

    history_ticks = 1  #: number of observations that `plan` takes, the latest one last
    observation_horizon = 1  #: ticks of these that the policy observes, the latest included
    execution_horizon = 1  #: ticks of a plan that are executed before the next plan
    control_hz = ft.CONTROL_HZ  #: ticks per second

    def reset(self) -> None:
        """Begin an episode."""

    def embed(self, observations: Sequence[Observation], /) -> None:
        """Do the part of `plan` that can be done before it; by default none."""

    def plan(self, observations: Sequence[Observation], /) -> Float32[np.ndarray, "h a"]:
        """Return the actions from the latest observation on."""
        raise NotImplementedError

    def env_config(self, config: Any, /) -> Any:
        """Return an environment's options with the images that the policy reads; by default unchanged."""
        return config
