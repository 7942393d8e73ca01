"""A rig's devices, connected: what the control loop reads and commands, and by which clock."""

import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.arms import franka, ur
from touchgoal.control.arms.streaming import ArmConfig
from touchgoal.control.cell.config import FingertipsRig, GripperRig, Rig, SafetyRig
from touchgoal.control.errors import UserError
from touchgoal.control.grippers.franka_hand import FrankaHand
from touchgoal.control.grippers.non_blocking import BackgroundGripper
from touchgoal.control.grippers.robotiq import Robotiq, RobotiqConfig
from touchgoal.control.interfaces import Arm, Camera, Gripper, LoadCell
from touchgoal.control.motion.kinematics import GELSIGHT_TCP
from touchgoal.control.safety.action_filter import Deadline, Watchdogs
from touchgoal.control.safety.limits import FR3, UR5E, Box, RobotLimits
from touchgoal.control.sensors.load_cell import LoadCellConfig, SerialLoadCell
from touchgoal.control.sensors.tactile_camera import (
    DIGIT_VIEW,
    GELSIGHT_MINI_VIEW,
    UNCHANGED,
    Fingertip,
)
from touchgoal.control.sensors.usb_cameras import find_sensor_camera
from touchgoal.control.sensors.video import VideoCamera, VideoConfig
from touchgoal.control.tactile.sensor_models import DIGIT, find_sensor

_STOP_AFTER = 5  # times the age at which the arm holds
_STANDS = 1.0  # s on the wall for which an arm's clock may stand
_LOOK = 0.002  # s between looks at it
_REMEMBERED = 2000  # of them


@runtime_checkable
class Clock(Protocol):
    """What a control loop goes by, in s."""

    def now(self) -> float:
        """The present, from any origin."""
        ...

    def age(self, stamp: float) -> float:
        """Since a reading's stamp."""
        ...

    def wait(self, until: float) -> None:
        """Return then, or at once if that has gone by."""
        ...


class RealClock:
    """The computer's monotonic clock."""

    def now(self) -> float:
        """See Clock."""
        return time.monotonic()

    def age(self, stamp: float) -> float:
        """See Clock."""
        return time.monotonic() - stamp

    def wait(self, until: float) -> None:
        """See Clock."""
        time.sleep(max(0.0, until - time.monotonic()))


class ArmClock:
    """The arm's own: of a twin in lock-step, whose time passes as slowly as the machine needs.

    Stamps count the time on the wall; what the arm's clock said then is remembered. When it stands
    for longer than a loaded machine explains, time goes on all the same, so that ages tell.
    """

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._told = deque([(time.monotonic(), arm.read().time)], maxlen=_REMEMBERED)

    def now(self) -> float:
        """See Clock."""
        news, wall = self._arm.read().time, time.monotonic()
        since, last = self._told[-1]
        if news > last:
            self._told.append((wall, news))
            return news
        return last + max(0.0, wall - since - _STANDS)

    def age(self, stamp: float) -> float:
        """See Clock."""
        return self.now() - float(np.interp(stamp, *np.array(self._told).T))

    def wait(self, until: float) -> None:
        """See Clock."""
        while self.now() < until:
            time.sleep(_LOOK)


@dataclass(frozen=True)
class Station:
    """Connected devices; `close` brings the arm to rest and releases all of them.

    Attributes:
        cameras: fingertips included, by their key in the vocabulary.
        truth: what a simulator knows (`sim_envs.twin.cell.Cell.truth`); None of a real cell. It may
            take a while: not for the control loop.
    """

    robot: RobotLimits
    arm: Arm
    gripper: Gripper
    cameras: dict[str, Camera]
    load_cell: LoadCell | None
    clock: Clock = field(default_factory=RealClock)
    truth: Callable[[], dict[str, Any]] | None = None

    def close(self) -> None:
        """The arm first; a device that fails to close holds up no other."""
        with ExitStack() as stack:
            for device in (self.load_cell, *self.cameras.values(), self.gripper, self.arm):
                if device is not None:
                    stack.callback(device.close)


def open_station(rig: Rig, hz: float) -> Station:
    """Connect to everything in a rig with a real arm or a twin; commands will come at `hz`.

    Raises:
        UserError, DriverError: something is not there; what was connected is released.
    """
    robot = limits_of(rig)
    with ExitStack() as undo:

        def keep(device: Any) -> Any:
            undo.callback(device.close)
            return device

        cameras = {}
        for name, camera in rig.cameras.items():
            config = VideoConfig(camera.source, camera.size, camera.rate)
            cameras[ft.IMAGE_PREFIX + name] = keep(VideoCamera(config))
        if rig.fingertips:
            for key, source in zip(
                ft.TACTILE, (rig.fingertips.left, rig.fingertips.right), strict=True
            ):
                cameras[key] = keep(_fingertip(rig.fingertips, source))
        load_cell = keep(SerialLoadCell(_load_cell(rig))) if rig.load_cell else None
        gripper = keep(_gripper(rig.gripper))
        arm = keep(_arm(rig, robot, hz))
        undo.pop_all()
    clock = ArmClock(arm) if rig.lock_step else RealClock()
    return Station(robot, arm, gripper, cameras, load_cell, clock)


def limits_of(rig: Rig) -> RobotLimits:
    """The robot's limits with the rig's own in place of some."""
    robot, own = UR5E if rig.arm == "ur5e" else FR3, rig.safety
    given = {
        name: value
        for name in ("velocity_share", "force", "torque", "touch")
        if (value := getattr(own, name)) is not None
    }
    boxes = {name: _box(getattr(robot, name), own, name) for name in ("flange", "fingertips")}
    return replace(robot, **given, **boxes)


def watchdogs_of(rig: Rig) -> Watchdogs:
    """The rig's own deadlines."""
    own = rig.safety
    return replace(
        Watchdogs(),
        observation=Deadline(own.observation_age, _STOP_AFTER * own.observation_age),
        state=Deadline(own.state_age, _STOP_AFTER * own.state_age),
    )


def _box(box: Box, own: SafetyRig, name: str) -> Box:
    lower, upper = getattr(own, f"{name}_lower"), getattr(own, f"{name}_upper")
    box = Box(
        box.lower if lower is None else np.array(lower),
        box.upper if upper is None else np.array(upper),
    )
    if (box.lower >= box.upper).any():
        raise UserError(f"safety.{name}_lower is not below safety.{name}_upper: swap them")
    return box


def _arm(rig: Rig, robot: RobotLimits, hz: float) -> Arm:
    ur5e = rig.arm == "ur5e"
    rate, silence = (ur.RATE, ur.SILENCE) if ur5e else (franka.RATE, franka.SILENCE)
    silence = rig.safety.silence or silence
    config = ArmConfig(rig.address, robot, GELSIGHT_TCP, hz, rate, silence)
    return ur.universal_robot(config) if ur5e else franka.franka(config)


def _gripper(rig: GripperRig) -> Gripper:
    if rig.kind == "franka_hand":
        return BackgroundGripper(FrankaHand(rig.address, rig.force))
    return Robotiq(RobotiqConfig(rig.port, rig.activate, force=rig.force, widths=rig.widths))


def _load_cell(rig: Rig) -> LoadCellConfig:
    assert rig.load_cell is not None
    cell = rig.load_cell
    return LoadCellConfig(cell.port, cell.newtons_per_count, cell.zero, cell.highest)


def _fingertip(rig: FingertipsRig, source: str) -> Fingertip:
    """By serial number over USB, or a stream whose pictures are the sensor's already."""
    model = find_sensor(rig.sensor)
    rate = rig.rate or model.frame_rate
    if "/" in source:
        return Fingertip(VideoCamera(VideoConfig(source, rate=rate)), model, UNCHANGED)
    view = DIGIT_VIEW if model.name == DIGIT.name else GELSIGHT_MINI_VIEW
    device = find_sensor_camera(model, source).device
    return Fingertip(VideoCamera(VideoConfig(device, rate=rate)), model, view)
