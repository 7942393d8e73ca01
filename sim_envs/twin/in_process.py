"""A rig with `arm = "sim"`: the twin's cell behind the drivers' protocols, in this process.

Nothing runs by itself: the cell goes on while the control loop waits for its next tick, and stamps
count simulated time. So a run repeats exactly, on however slow a machine; it never runs faster than
the clock on the wall.
"""

import time
from dataclasses import replace

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.cell.config import Rig
from touchgoal.control.cell.connection import Station, limits_of
from touchgoal.control.errors import UserError
from touchgoal.control.interfaces import (
    ArmReading,
    Camera,
    DriverError,
    Frame,
    GripperReading,
    Joints,
    LoadReading,
)
from touchgoal.control.motion.tracker import Tracker, TrackerState
from touchgoal.control.tactile.sensor_models import SensorModel, find_sensor
from touchgoal.sim_envs.base import GRIPPER_SPEED, STREAMED
from touchgoal.sim_envs.bead_maze import BeadMazeConfig
from touchgoal.sim_envs.pick_place import PickPlaceConfig
from touchgoal.sim_envs.tasks import TaskConfig, make_env
from touchgoal.sim_envs.twin.cell import DT, Cell

_HOLDS = 0.005  # m between the width asked for and the width there is, that mean something is held


class SimulatedClock:
    """See Clock; waiting advances the cell, and what moves it."""

    def __init__(self, cell: Cell, arm: "SimulatedArm") -> None:
        self._cell, self._arm = cell, arm
        self._due = time.monotonic()

    def now(self) -> float:
        """Simulated s."""
        return self._cell.time

    def age(self, stamp: float) -> float:
        """See Clock."""
        return self._cell.time - stamp

    def wait(self, until: float) -> None:
        """Let the cell go on until then."""
        begin = self._cell.time
        while self._cell.time < until - DT / 2:
            self._arm.step()
            self._cell.step()
        self._cell.env.refresh()
        self._due = max(self._due, time.monotonic() - 1.0) + self._cell.time - begin
        time.sleep(max(0.0, self._due - time.monotonic()))


class SimulatedArm:
    """The Arm protocol over the cell; targets go through the tracker, as with the real drivers."""

    def __init__(self, cell: Cell, hz: float) -> None:
        self._cell, self._limits = cell, cell.env.robot.interface
        self._tracker = Tracker(self._limits, 1 / hz, DT)
        self._state: TrackerState | None = None
        self._refusal = ""

    def read(self) -> ArmReading:
        """See Arm."""
        cell = self._cell
        return ArmReading(
            q=cell.q.copy(),
            velocity=cell.dq.copy(),
            wrench=cell.env.external_wrench().copy(),
            torque=cell.tau_ext.copy(),
            fault=self._refusal,
            stamp=cell.time,
            time=cell.time,
        )

    def command(self, q: Joints) -> None:
        """See Arm."""
        if self._refusal:
            raise DriverError(f"no command is taken: {self._refusal}")
        limits = self._limits
        if not (np.isfinite(q).all() and (q >= limits.lower).all() and (q <= limits.upper).all()):
            raise UserError(f"the target {np.round(q, 3).tolist()} rad is beyond a joint's range")
        if self._state is None:
            self._state = self._tracker.start(self._cell.q_d.copy())
        self._state = self._tracker.aim(self._state, q)

    def stop(self) -> None:
        """See Arm."""
        self._state = None
        self._refusal = self._refusal or "stopped on request; recover the arm to go on"
        self._cell.brake(self._limits.acceleration)

    def recover(self) -> None:
        """See Arm."""
        self._refusal = ""

    def close(self) -> None:
        """See Arm."""
        self.stop()

    def step(self) -> None:
        """One millisecond of the stream."""
        if self._state is None:
            return
        before = self._state.q
        self._state = self._tracker.step(self._state)
        self._cell.follow(self._state.q, (self._state.q - before) / DT)


class SimulatedGripper:
    """The Gripper protocol over the cell; it closes with `force` (N)."""

    def __init__(self, cell: Cell, force: float) -> None:
        self._cell, self._force = cell, force

    def read(self) -> GripperReading:
        """See Gripper."""
        cell = self._cell
        width = cell.env.width()
        return GripperReading(width, width - cell.grip.width > _HOLDS, "", cell.time)

    def command(self, width: float) -> None:
        """See Gripper."""
        self._cell.grasp(width, GRIPPER_SPEED, self._force)

    def stop(self) -> None:
        """See Gripper."""

    def close(self) -> None:
        """See Gripper."""


class SimulatedCamera:
    """The Camera protocol over one of the cell's; a picture is taken when it is looked at."""

    def __init__(self, cell: Cell, name: str, rate: float) -> None:
        self._cell, self._name, self._rate = cell, name, rate
        self._frame: Frame | None = None

    @property
    def rate(self) -> float:
        """See Camera."""
        return self._rate

    @property
    def trouble(self) -> str:
        """See Camera."""
        return ""

    def read(self) -> Frame:
        """See Camera."""
        now, last = self._cell.time, self._frame
        number = int((now + DT / 2) * self._rate)
        if last is None or number > last.sequence:
            last = self._frame = Frame(self._take(), number, now)
        return last

    def close(self) -> None:
        """See Camera."""

    def _take(self) -> np.ndarray:
        return self._cell.env.picture(self._name)


class SimulatedFingertip(SimulatedCamera):
    """The TactileSensor protocol over one of the cell's."""

    def __init__(self, cell: Cell, side: int, model: SensorModel) -> None:
        super().__init__(cell, ft.TACTILE[side], model.frame_rate)
        self._side, self.model = side, model

    def _take(self) -> np.ndarray:
        return self._cell.env.feel(self._side).image


class SimulatedLoadCell:
    """The LoadCell protocol: under the table."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell

    def read(self) -> LoadReading:
        """See LoadCell."""
        return LoadReading(self._cell.env.table_load(), 0, self._cell.time)

    def close(self) -> None:
        """See LoadCell."""


def simulate(rig: Rig, hz: float) -> Station:
    """The station of a rig with `arm = "sim"`: its sensors, task and limits, in simulation."""
    task = rig.task
    chosen = {"object": task.object, "wire": task.wire}
    env = make_env(task_of(rig))
    cell = Cell(env, task.seed, {name: value for name, value in chosen.items() if value})
    env.refresh()
    arm = SimulatedArm(cell, hz)
    cameras: dict[str, Camera] = {
        ft.IMAGE_PREFIX + name: SimulatedCamera(cell, name, camera.rate)
        for name, camera in rig.cameras.items()
    }
    if rig.fingertips:
        model = find_sensor(rig.sensor)
        cameras |= {key: SimulatedFingertip(cell, i, model) for i, key in enumerate(ft.TACTILE)}
    return Station(
        limits_of(rig),
        arm,
        SimulatedGripper(cell, rig.gripper.force),
        cameras,
        SimulatedLoadCell(cell) if rig.load_cell else None,
        SimulatedClock(cell, arm),
        cell.truth,
    )


def task_of(rig: Rig) -> TaskConfig:
    """The task's own options with the rig's sensors, at the rate of a deployment."""
    task = BeadMazeConfig() if rig.task.name == "bead-maze" else PickPlaceConfig()
    scene = replace(task.scene, sensor=rig.sensor)
    return replace(
        task,
        cameras=tuple(rig.cameras),
        camera_size=STREAMED,
        tactile=rig.fingertips is not None,
        scene=scene,
        control_hz=ft.CONTROL_HZ,
    )
