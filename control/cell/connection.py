"""A cell's connected devices, and the clock that the control loop follows."""

import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from socket import socket
from typing import Any, Protocol, cast, runtime_checkable

from touchgoal.control import features as ft
from touchgoal.control.arms import franka, ur
from touchgoal.control.arms.driver_process import error_line
from touchgoal.control.arms.streaming import ArmConfig, ArmProcess
from touchgoal.control.cell.config import CameraName, CellConfig, FingertipsSection
from touchgoal.control.cell.limits import cell_limits
from touchgoal.control.cell.twin_client import LockStepClock, ask_twin, lease_twin, reset_scene
from touchgoal.control.grippers.franka_hand import FrankaHand, NonBlockingGripper
from touchgoal.control.grippers.robotiq import Robotiq
from touchgoal.control.interfaces import Arm, Camera, Gripper, LoadCell, TactileSensor
from touchgoal.control.safety.limits import RobotLimits
from touchgoal.control.sensors.fingertip_source import fingertip_video
from touchgoal.control.sensors.load_cell import SerialLoadCell
from touchgoal.control.sensors.tactile_camera import TactileCamera, fingertip_view
from touchgoal.control.sensors.video import VideoCamera, VideoConfig
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.runtime.errors import CheckResult, require_all_ok

# Hz, and s of wall time without an image: slow enough for any loaded machine.
_LOCK_STEP_RATE, _LOCK_STEP_TIMEOUT = 0.1, 10.0
_TWIN_RATE = 25.0  # Hz of a twin's images in its own time, at least


@runtime_checkable
class Clock(Protocol):
    """Clock of a control loop, s."""

    def now(self) -> float:
        """Return the present time, from any origin."""
        ...

    def age(self, stamp: float) -> float:
        """Return the time since a reading's stamp."""
        ...

    def wait(self, until: float) -> None:
        """Wait until that time, if it lies ahead."""


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


@dataclass(frozen=True)
class CellConnection:
    """Connected devices; `close` brings the arm to rest and releases all of them.

    `cameras` include the fingertips, by their key in `features`. `truth` returns what a simulator
    knows, and may take a while; None for a real cell.
    """

    robot: RobotLimits
    arm: Arm
    gripper: Gripper
    cameras: dict[str, Camera]
    load_cell: LoadCell | None
    clock: Clock = field(default_factory=RealClock)
    truth: Callable[[], dict[str, Any]] | None = None
    lease: socket | None = None  # of the twin; others may use it once this is closed

    @property
    def fingertips(self) -> dict[str, TactileSensor]:
        """Those of the cameras that are fingertips."""
        return {key: c for key, c in self.cameras.items() if isinstance(c, TactileSensor)}

    def close(self) -> None:
        """Close the arm first; a device that fails to close is named, and holds up nothing."""
        clock = self.clock if isinstance(self.clock, LockStepClock) else None
        devices = (self.arm, self.gripper, *self.cameras.values(), self.load_cell)
        for device in (clock, *devices, self.lease):
            _close(device)


def _close(device: Any) -> None:
    try:
        if device is not None:
            device.close()
    except Exception as error:  # of any driver
        print(f"{type(device).__name__} did not close: {error}", file=sys.stderr)


def connect_cell(cell: CellConfig, new_episode: bool = True) -> CellConnection:
    """Connect to everything in a cell with a real arm or a twin.

    A twin is taken until the connection closes. It first puts the scene of `task.seed` back, or goes on
    with its own if not `new_episode`. UserError: another program has the twin; or devices do not open,
    all of which are named, after a row for each. The others are released, the last opened first.
    Nothing has moved then, so there is no run and no ending.
    """
    robot, rows = cell_limits(cell), list[CheckResult]()
    with ExitStack() as undo:
        lease = undo.enter_context(lease_twin(cell.task.twin)) if cell.task.twin else None
        if lease and new_episode:
            reset_scene(cell.task.twin, cell.task.seed)
            print(f"the twin has put its scene back (seed {cell.task.seed})", flush=True)

        def opened(name: str, open_device: Callable[[], Any]) -> Any:
            try:
                device = open_device()
            except Exception as error:  # of any driver
                rows.append(CheckResult(name, False, "", error_line(error)))
                return None
            rows.append(CheckResult(name, True, "opened"))
            undo.callback(_close, device)
            return device

        cameras: dict[str, Camera] = {
            key: opened(key.removeprefix(ft.IMAGE_PREFIX), partial(connect_camera, cell, key))
            for key in camera_formats(cell)
        }
        load_cell = None
        if cell.load_cell:
            load_cell = opened("load cell", partial(SerialLoadCell, cell.load_cell))
        gripper = opened("gripper", partial(_gripper, cell))
        arm = opened("arm", partial(connect_arm, cell))
        if not all(row.ok for row in rows):
            print("\n".join(map(str, rows)), flush=True)
            require_all_ok(rows)
        clock: Clock = RealClock()
        if cell.lock_step:
            clock = LockStepClock(cell.task.twin, arm, gripper, cameras, load_cell)
            if new_episode:
                clock.reset(cell.task.seed)
            else:
                clock.go_on()
        undo.pop_all()
    truth = partial(ask_twin, cell.task.twin, "truth") if cell.task.twin else None
    return CellConnection(robot, arm, gripper, cameras, load_cell, clock, truth, lease)


def camera_formats(cell: CellConfig) -> dict[str, tuple[float, int, int]]:
    """Return rate (Hz), height and width (px) of a cell's recorded images by their keys in `features`."""
    rows, columns, _ = ft.CAMERA_SHAPE
    formats = {
        ft.IMAGE_PREFIX + name: (own.rate, rows, columns) for name, own in cell.cameras.items()
    }
    if tips := cell.fingertips:
        model = find_sensor(tips.sensor)
        tip = tips.rate or model.frame_rate, *model.image_shape
        formats |= dict.fromkeys(ft.TACTILE, tip)
    return formats


def connect_camera(cell: CellConfig, key: str) -> Camera:
    """Open a camera or a fingertip of a cell by its key in `features`; UserError if it is missing."""
    if cell.fingertips and key in ft.TACTILE:
        return _tactile_camera(cell, cell.fingertips, ft.TACTILE.index(key))
    own = cell.cameras[cast(CameraName, key.removeprefix(ft.IMAGE_PREFIX))]
    config = VideoConfig(own.source, own.size, own.rate, own.exposure, own.white_balance)
    return VideoCamera(_timed(config, cell))


def connect_arm(cell: CellConfig, recover: bool = False) -> ArmProcess:
    """Connect to a cell's arm alone; `recover` clears a fault first: only when a person asked for it.

    DriverError if the arm is missing or refuses the connection.
    """
    ur5e = cell.arm == "ur5e"
    rate, timeout = (ur.RATE, ur.STATE_TIMEOUT) if ur5e else (franka.RATE, franka.STATE_TIMEOUT)
    timeout = cell.safety.state_timeout or timeout
    config = ArmConfig(cell.address, cell_limits(cell), rate, timeout, cell.lock_step)
    return ArmProcess(ur.UrClient if ur5e else franka.FrankaClient, config, recover)


def _gripper(cell: CellConfig) -> Gripper:
    own = cell.gripper
    if own.kind == "robotiq":
        return Robotiq(own)
    hand = FrankaHand(own.address, own.force, cell.lock_step)
    return hand if cell.lock_step else NonBlockingGripper(hand)


def _tactile_camera(whole: CellConfig, cell: FingertipsSection, side: int) -> TactileCamera:
    """Open the left (0) or right (1) fingertip at a device, a USB serial number or a stream."""
    source = (cell.left, cell.right)[side]
    model = find_sensor(cell.sensor_files[side] if cell.sensor_files else cell.sensor)
    corners = cell.corners[side] if cell.corners else None
    config = replace(
        fingertip_video(source, model),
        size=cell.size,
        rate=cell.rate or model.frame_rate,
        exposure=cell.exposure,
        white_balance=cell.white_balance,
    )
    view = fingertip_view(model, source, cell.border, corners)
    return TactileCamera(VideoCamera(_timed(config, whole)), model, view)


def _timed(config: VideoConfig, cell: CellConfig) -> VideoConfig:
    """Return the video's settings without deadlines for a lock-step twin, whose images come late."""
    if not cell.lock_step:
        return config
    return replace(
        config,
        rate=_LOCK_STEP_RATE,
        timeout=_LOCK_STEP_TIMEOUT,
        frozen_after=0.0,
        frozen_images=round(config.frozen_after * _TWIN_RATE),
    )
