"""Checks of a cell file across its fields; each UserError names the key."""

from difflib import get_close_matches
from typing import get_args

import numpy as np

from touchgoal.control.cell.config import CellConfig, SimulatedTask, TaskSection, ToolSection
from touchgoal.control.cell.limits import cell_box
from touchgoal.control.motion.tool import ROBOTIQ_2F85
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.runtime.errors import UserError

# Range of grasp forces, N; a simulated Franka Hand can press less.
_FORCES = {"franka_hand": (30.0, 70.0), "robotiq": ROBOTIQ_2F85.force}
_JOINTS = {"fr3": 7, "ur5e": 6, "sim": 7}
_LEAST_FINGERTIP = 0.01  # m, each side of the box around the fingertips
_UNIT = 1e-3  # by which a quaternion's length may differ from 1
_BELOW_FLOOR = 0.005  # m below the fingertips' box that a grasp may lie: the plan raises it


def check(cell: CellConfig) -> None:
    """Check how the sections fit together."""
    _check_devices(cell)
    _check_fingertips(cell)
    for name, camera in cell.cameras.items():
        if (camera.pose is None) != (camera.fovy is None):
            raise UserError(
                f"cameras.{name} has only one of pose and fovy: calibrate-camera writes both"
            )
        if camera.pose and abs(np.linalg.norm(camera.pose[3:]) - 1) > _UNIT:
            raise UserError(f"cameras.{name}.pose must end with a unit quaternion wxyz")
    for name in ("flange", "fingertips"):
        cell_box(cell, name)
    if cell.tool is not None:
        _check_tool(cell.tool)
    _check_task(cell)


def _check_devices(cell: CellConfig) -> None:
    gripper = cell.gripper
    if cell.lock_step and cell.arm != "fr3":
        raise UserError("lock_step is for an FR3's twin: leave it out")
    if cell.arm != "sim":
        if not cell.address:
            raise UserError("address is missing: give the arm's, such as 172.16.0.2")
        needed = {"franka_hand": "address", "robotiq": "port"}[gripper.kind]
        if not getattr(gripper, needed):
            raise UserError(f"gripper.{needed} is missing: a {gripper.kind} needs it")
        if cell.tool is None:
            raise UserError(
                "tool is missing: measure tcp, mass, centre_of_mass and finger_corners of what the "
                "arm carries; control/cell/examples/fr3_two_minis.toml and ur5e.toml show those of "
                "two GelSight Minis"
            )
    least, most = _FORCES[gripper.kind]
    if gripper.kind == "franka_hand" and cell.moves_nothing_real:
        least = 0.0
    if not least <= gripper.force <= most:
        raise UserError(
            f"gripper.force must lie between {least:g} and {most:g} N, what a {gripper.kind} can do, "
            f"not {gripper.force:g}"
        )
    if gripper.widths[0] <= gripper.widths[1]:
        raise UserError("gripper.widths must be the open width, then the closed one, in metres")


def _check_fingertips(cell: CellConfig) -> None:
    tips = cell.fingertips
    if tips is None:
        return
    for side, source in (("left", tips.left), ("right", tips.right)):
        if source != "simulated" and get_close_matches(source, ["simulated"], 1):
            raise UserError(f"fingertips.{side} is {source!r}: did you mean 'simulated'?")
    if cell.arm != "sim" and tips.left == tips.right:
        raise UserError(
            f"fingertips.left and fingertips.right are both {tips.left!r}: give each its own sensor"
        )
    try:
        model = find_sensor(tips.sensor)
    except UserError as error:
        raise UserError(f"fingertips.sensor: {error}") from error
    for folder in tips.sensor_files or ():
        try:
            own = find_sensor(folder)
        except UserError as error:
            raise UserError(f"fingertips.sensor_files: {error}") from error
        if own.image_shape != model.image_shape:
            raise UserError(f"fingertips.sensor_files: {folder} is of a {own.name}")


def _check_tool(tool: ToolSection) -> None:
    """Require that the box around the open fingertips has a size and contains the TCP."""
    corners = np.array(tool.finger_corners)
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    if (upper - lower < _LEAST_FINGERTIP).any():
        raise UserError(
            f"tool.finger_corners span {np.round(1e3 * (upper - lower), 1).tolist()} mm: give the corners "
            "of a box around both fingertips of the open hand, in metres"
        )
    tcp = np.array([0.0, 0.0, tool.tcp])
    if not ((lower <= tcp) & (tcp <= upper)).all():
        raise UserError(
            f"tool.finger_corners leave out the TCP, {tool.tcp:g} m from the flange: measure both from "
            "the flange, along the hand's z axis"
        )


def _check_own_task(task: TaskSection) -> None:
    """Refuse a misspelt name, and a scripted or shipped policy for a task of one's own."""
    if near := get_close_matches(task.name, get_args(SimulatedTask), 1, cutoff=0.75):
        raise UserError(
            f"task.name is {task.name}: did you mean {near[0]}? Else choose another name"
        )
    if task.policy in ("expert", "follower", "shipped"):
        raise UserError(
            f"task.policy: {task.policy} is for {' and '.join(get_args(SimulatedTask))}; for {task.name!r} "
            "name a folder that train-policy made, or record demonstrations with record-demos"
        )


def _check_task(cell: CellConfig) -> None:
    task = cell.task
    if task.judge and (task.rewards or task.normalizer):
        raise UserError("task.judge has its own goals: leave out task.rewards and task.normalizer")
    if not (task.rewards or task.judge) and (task.normalizer or task.encoder):
        what = "normalizer" if task.normalizer else "encoder"
        raise UserError(f"task.{what} does nothing without task.rewards: name a goal there")
    if task.start is not None and len(task.start) != _JOINTS[cell.arm]:
        raise UserError(
            f"task.start must be {_JOINTS[cell.arm]} joint positions of the {cell.arm} in rad, "
            f"not {len(task.start)}"
        )
    other = "wires" if task.simulated == "pick-place" else "objects"
    if getattr(task, other):
        raise UserError(f"task.{other} does nothing in {task.simulated}: leave it out")
    if task.own:
        _check_own_task(task)
    if task.policy == "follower" and task.name != "bead-maze":
        raise UserError("task.policy: the follower is for the bead-maze; use expert or a folder")
    if task.policy != "expert":
        return
    if task.name == "bead-maze":
        raise UserError(
            "task.policy: the maze's expert lives in the simulator; use follower or shipped"
        )
    if cell.arm != "sim" and not (task.twin or (task.grasp and task.goal)):
        raise UserError("task.grasp and task.goal are missing: measure where they are, in metres")
    box = cell_box(cell, "fingertips")
    for key, place in (("grasp", task.grasp), ("goal", task.goal)):
        if place is None:
            continue
        given = np.array(place[:3])
        lower, upper = box.lower[: given.size], box.upper[: given.size]
        if given.size == 3:
            lower = lower - [0.0, 0.0, _BELOW_FLOOR]
        if not ((lower <= given) & (given <= upper)).all():
            raise UserError(
                f"task.{key} {given.tolist()} is outside the fingertips' box, {box.lower.tolist()} to "
                f"{box.upper.tolist()} (m, base frame): measure it again, or set safety.fingertips_lower "
                "and _upper"
            )
