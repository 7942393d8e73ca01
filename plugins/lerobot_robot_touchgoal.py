"""A cell's arm in lerobot: `--robot.type=touchgoal --robot.cell=cell.toml`, inside the cell's limits."""

from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot_teleoperator_touchgoal import MOTION, AskedMotion

from touchgoal.control import features as ft
from touchgoal.control.cell.cell_file import find_cell_file, read_cell_file
from touchgoal.control.cell.connection import (
    CellConnection,
    RealClock,
    camera_formats,
    connect_cell,
)
from touchgoal.control.cell.limits import cell_limits
from touchgoal.control.deployment.control_loop import PLAN_ENDED, ControlLoop
from touchgoal.control.interfaces import Actor, DriverError
from touchgoal.control.run_log import RunLog
from touchgoal.control.teleoperation.device import TeleoperationConfig
from touchgoal.control.teleoperation.teleoperator import Teleoperator
from touchgoal.launch.support.cell_run import check_cell, confirm
from touchgoal.runtime.errors import UserError


@RobotConfig.register_subclass("touchgoal")
@dataclass(kw_only=True)
class TouchgoalRobotConfig(RobotConfig):
    """Options of the robot."""

    cell: str
    """Cell file of an arm, or the cell.json of a twin."""
    yes: bool = False
    """Do not ask for the typed confirmation (for tests)."""
    columns: list[str] = field(default_factory=lambda: ["state"])
    """Numbers that lerobot records as one `observation.state`: state, command, tcp_pose, wrench, load, age."""
    actions: Literal["joints", "hand"] = "joints"
    """What an action is: the joints' changes, or the hand's motion, as `--teleop.type=touchgoal` gives it."""


class TouchgoalRobot(Robot):
    """Arm, hand, cameras and fingertips of a cell; names and units are those of `control/features.py`.

    Every action passes the filter and the checks of `deploy`. One that stops the arm raises DriverError;
    connect again to go on. Send actions at `features.CONTROL_HZ`: without a new one the arm comes to rest.
    """

    config_class, name = TouchgoalRobotConfig, "touchgoal"

    def __init__(self, config: TouchgoalRobotConfig) -> None:
        super().__init__(config)
        self._yes, self._cell = config.yes, read_cell_file(find_cell_file(Path(config.cell)))
        if self._cell.arm == "sim":
            raise UserError("give the cell file of an arm or of a twin, not of a simulated arm")
        features = ft.features_of(len(cell_limits(self._cell).arm.home))
        self._columns: dict[str, list[str]] = {}
        for column in config.columns:
            key, absent = f"observation.{column}", ft.LOAD if self._cell.load_cell is None else ""
            if key not in features or key == absent or key.startswith(ft.IMAGE_PREFIX):
                raise UserError(f"this cell has no column {column}: leave it out of columns")
            start = "" if key == ft.STATE else f"{column}."
            self._columns[key] = [start + name for name in features[key].names]
        self._led = AskedMotion() if config.actions == "hand" else None
        self._action = MOTION if self._led else features[ft.ACTION].names
        formats = camera_formats(self._cell).items()
        self._images = {key.removeprefix(ft.IMAGE_PREFIX): (*f[1:], 3) for key, f in formats}
        self._connection: CellConnection | None = None

    observation_features = property(
        lambda self: dict.fromkeys(sum(self._columns.values(), []), float) | self._images
    )
    action_features = property(lambda self: dict.fromkeys(self._action, float))
    cameras = property(lambda self: self._images)
    is_connected = property(lambda self: self._connection is not None)
    is_calibrated = True

    def calibrate(self) -> None:
        """Do nothing: a cell file holds the calibration."""

    configure = calibrate

    def connect(self, calibrate: bool = True) -> None:
        """Ask the operator, connect and run `deploy`'s checks; UserError or DriverError if one fails."""
        if not self._yes:
            confirm(self._cell)
        connection = connect_cell(self._cell)
        try:
            with TemporaryDirectory(dir=".") as nowhere:  # lerobot records by itself
                safety = check_cell(self._cell, connection, Path(nowhere))
            self._loop = ControlLoop(connection, safety, True, lambda: "", lambda tick: None)
            if self._led:
                hand = TeleoperationConfig()
                self._hand = _Led(self._led, safety, self._loop.commanded, hand)
        except BaseException:
            connection.close()
            raise
        self._connection = connection

    def get_observation(self) -> dict[str, Any]:
        """Return the newest numbers and images."""
        seen = self._loop.reader.read().observation
        found: dict[str, Any] = {name: seen[ft.IMAGE_PREFIX + name] for name in self._images}
        for key, names in self._columns.items():
            found |= zip(names, seen[key].tolist(), strict=True)
        return found

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Run one control tick; return the action as it was done. DriverError: the arm was stopped."""
        log, clock = RunLog(), self._connection.clock
        asked = self._led.ask(action) if self._led else action
        wanted = [float(asked[name]) for name in self._action]
        actor = self._hand if self._led else _OneAction(np.array(wanted))
        ending = self._loop.run(actor, np.inf, log)
        if ending.reason != PLAN_ENDED:
            raise DriverError(str(ending))
        if not isinstance(clock, RealClock):  # a lock-step twin's time goes on only so
            clock.wait(clock.now() + 1 / ft.CONTROL_HZ)
        done = wanted if self._led else log.newest[ft.ACTION].tolist()
        return dict(zip(self._action, done, strict=True))

    def disconnect(self) -> None:
        """Bring the arm to rest and release the cell."""
        if self._connection is not None:
            self._connection.close()
        self._connection = None


class _OneAction(Actor):
    done = True

    def __init__(self, action: np.ndarray) -> None:
        self._action = action

    def act(self, observation: ft.Observation) -> np.ndarray:
        return self._action


class _Led(Teleoperator):
    """One tick at a time; the wrench of the first one is that of the free hand."""

    done, _begun = True, False

    def start(self, observation: ft.Observation) -> None:
        if not self._begun:
            super().start(observation)
        self._begun = True
