"""A cell's limits: the robot's, overridden by the task's ceilings and by the cell file."""

from dataclasses import replace

import numpy as np

from touchgoal.control.cell.config import CellConfig
from touchgoal.control.safety.action_filter import Deadline, Watchdogs
from touchgoal.control.safety.limits import FR3, TASK_FORCES, UR5E, Box, RobotLimits
from touchgoal.control.tactile.indentation import deepest_readable
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.runtime.errors import UserError

_STOP_FACTOR = 5  # times the age at which the arm holds


def cell_limits(cell: CellConfig) -> RobotLimits:
    """Return the robot's limits in this cell."""
    robot, own = _robot(cell), cell.safety
    if cell.tool is not None and cell.arm != "sim":
        tool = cell.tool
        robot = replace(
            robot,
            tool=replace(
                robot.tool,
                tcp_offset=tool.tcp,
                mass=tool.mass,
                centre_of_mass=tool.centre_of_mass,
                finger_corners=tool.finger_corners,
            ),
        )
    forces, given, indentation = TASK_FORCES.get(cell.task.name), {}, robot.indentation
    if forces is not None:
        given = {"force": forces.force_ceiling, "torque": forces.torque_ceiling}
        indentation = forces.indentation_ceiling
    if cell.fingertips is not None:
        sensor = find_sensor(cell.fingertips.sensor)
        given["indentation"] = deepest_readable(sensor, indentation)
    given |= {
        name: value
        for name in ("tip_speed", "velocity_share", "force", "torque", "indentation")
        if (value := getattr(own, name)) is not None
    }
    boxes = {name: cell_box(cell, name) for name in ("flange", "fingertips")}
    return replace(robot, **given, **boxes)


def cell_watchdogs(cell: CellConfig) -> Watchdogs:
    """Return the deadlines with the cell's own ages."""
    own = cell.safety
    return Watchdogs(
        observation=Deadline(own.observation_age, _STOP_FACTOR * own.observation_age),
        state=Deadline(own.state_age, _STOP_FACTOR * own.state_age),
    )


def cell_box(cell: CellConfig, name: str) -> Box:
    """Return the box of the `flange` or the `fingertips`; UserError if its corners are no box."""
    box: Box = getattr(_robot(cell), name)
    lower, upper = (getattr(cell.safety, f"{name}_{end}") for end in ("lower", "upper"))
    box = Box(
        box.lower if lower is None else np.array(lower),
        box.upper if upper is None else np.array(upper),
    )
    if (box.lower >= box.upper).any():
        raise UserError(
            f"safety.{name}_lower {box.lower.tolist()} is not below safety.{name}_upper "
            f"{box.upper.tolist()}: swap them, or give both corners"
        )
    return box


def _robot(cell: CellConfig) -> RobotLimits:
    return UR5E if cell.arm == "ur5e" else FR3
