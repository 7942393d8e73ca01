"""The simulated cell behind the drivers' interfaces, for cell files with `arm = "sim"`.

It advances only while the control loop waits, no faster than the clock: a run repeats exactly.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control import interfaces
from touchgoal.control.arrays import Image
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.cell.connection import CellConnection
from touchgoal.control.cell.limits import cell_limits
from touchgoal.control.motion.tracker import Tracker, TrackerState
from touchgoal.control.tactile.sensor_models import SensorModel, find_sensor
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.simulated_cell import DT, SimulatedCell
from touchgoal.sim_envs.config import STREAM_SIZE
from touchgoal.sim_envs.tasks import make_env
from touchgoal.sim_envs.twin.cell_task import env_config_of

_HELD_FORCE = 0.5  # N on both pads that mean something is held


class _Clock:
    """Waiting advances the cell and its arm."""

    def __init__(self, cell: SimulatedCell, arm: "_Arm") -> None:
        self._cell, self._arm = cell, arm
        self._next_step_at = time.monotonic()

    def now(self) -> float:
        return self._cell.time

    def age(self, stamp: float) -> float:
        return self._cell.time - stamp

    def wait(self, until: float) -> None:
        begin = self._cell.time
        while self._cell.time < until - DT / 2:
            self._arm.step()
            self._cell.step()
        self._cell.env.update_contacts()
        earliest = time.monotonic() - 1.0
        self._next_step_at = max(self._next_step_at, earliest) + self._cell.time - begin
        time.sleep(max(0.0, self._next_step_at - time.monotonic()))


class _Arm:
    """Arm interface of the cell; targets pass the tracker, as with the real drivers."""

    def __init__(self, cell: SimulatedCell, hz: float) -> None:
        self._cell, self._limits = cell, cell.env.robot.interface
        self._tracker = Tracker(self._limits, cell.env.robot.policy.velocity, 1 / hz, DT)
        self._state: TrackerState | None = None
        self._refused_because = ""

    def read(self) -> interfaces.ArmReading:
        cell = self._cell
        return interfaces.ArmReading(
            q=cell.q.copy(),
            velocity=cell.dq.copy(),
            wrench=cell.env.external_wrench() + cell.wrench_error,
            torque=cell.tau_ext.copy(),
            fault=self._refused_because,
            stamp=cell.time,
            time=cell.time,
        )

    def command(self, q: interfaces.Joints) -> None:
        if self._refused_because:
            raise interfaces.DriverError(f"no command is taken: {self._refused_because}")
        limits = self._limits
        if not (np.isfinite(q).all() and (q >= limits.lower).all() and (q <= limits.upper).all()):
            raise UserError(f"the target {np.round(q, 3).tolist()} rad is beyond a joint's range")
        if self._state is None:
            self._state = self._tracker.start(self._cell.q_d.copy())
        self._state = self._tracker.set_target(self._state, q)

    def stop(self) -> None:
        self._state = None
        if not self._refused_because:
            self._refused_because = f"{interfaces.STOPPED_ON_REQUEST}; recover the arm to go on"
        self._cell.brake(self._limits.acceleration)

    def close(self) -> None:
        self.stop()

    def step(self) -> None:
        """Advance the stream of set-points by a millisecond."""
        if self._state is None:
            return
        before = self._state.q
        self._state = self._tracker.step(self._state)
        self._cell.set_target(self._state.q, (self._state.q - before) / DT)


class _Gripper:
    """Gripper interface of the cell; it closes with `force` (N)."""

    def __init__(self, cell: SimulatedCell, force: float) -> None:
        self._cell, self._force = cell, force
        self._stopped = False

    def read(self) -> interfaces.GripperReading:
        env = self._cell.env
        held = min(pad.normal_force for pad in env.pad_contacts()) > _HELD_FORCE
        return interfaces.GripperReading(env.width(), held, "", self._cell.time)

    def command(self, width: float) -> None:
        if self._stopped:
            raise interfaces.DriverError("no command is taken: the gripper was stopped")
        self._go(width)

    def stop(self, release_to: float | None = None) -> None:
        # A held object stays pressed.
        cell = self._cell
        if release_to is not None:
            self._go(release_to)
        elif not self._stopped and not self.read().grasped:
            self._go(cell.env.width())
        self._stopped = True

    def close(self) -> None:
        pass

    def _go(self, width: float) -> None:
        self._cell.command_gripper(width, self._cell.env.robot.tool.speed, self._force)


class _Camera:
    """Camera interface of the cell; an image is rendered when it is read."""

    problem = ""

    def __init__(self, cell: SimulatedCell, rate: float, take: Callable[[], Image]) -> None:
        self._cell, self.rate, self._take = cell, rate, take
        self._frame: interfaces.Frame | None = None

    def read(self) -> interfaces.Frame:
        now, last = self._cell.time, self._frame
        number = int((now + DT / 2) * self.rate)
        if last is None or number > last.sequence:
            last = self._frame = interfaces.Frame(self._take(), number, now)
        return last

    def close(self) -> None:
        pass


class _TactileCamera(_Camera):
    """TactileSensor interface of the cell."""

    def __init__(self, cell: SimulatedCell, side: int, model: SensorModel) -> None:
        super().__init__(cell, model.frame_rate, lambda: cell.env.read_tactile(side).image)
        self.model = model


class _LoadCell:
    """LoadCell interface of the cell: the force on the table."""

    def __init__(self, cell: SimulatedCell) -> None:
        self._cell = cell

    def read(self) -> interfaces.LoadReading:
        return interfaces.LoadReading(self._cell.env.table_load(), 0, self._cell.time)

    def close(self) -> None:
        pass


def simulate_cell(config: CellConfig, hz: float) -> CellConnection:
    """Connect to a simulated cell: sensors, task and limits of a cell file with `arm = "sim"`."""
    env = make_env(replace(env_config_of(config), camera_size=STREAM_SIZE))
    cell = SimulatedCell(env, config.task.seed)
    env.update_contacts()
    arm = _Arm(cell, hz)
    cameras: dict[str, interfaces.Camera] = {
        ft.IMAGE_PREFIX + name: _Camera(cell, camera.rate, partial(env.render_camera, name))
        for name, camera in config.cameras.items()
    }
    if config.fingertips:
        model = find_sensor(config.sensor)
        cameras |= {key: _TactileCamera(cell, i, model) for i, key in enumerate(ft.TACTILE)}
    return CellConnection(
        cell_limits(config),
        arm,
        _Gripper(cell, config.gripper.force),
        cameras,
        _LoadCell(cell) if config.load_cell else None,
        _Clock(cell, arm),
        cell.truth,
    )
