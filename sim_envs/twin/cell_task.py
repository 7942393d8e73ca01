"""The simulated task that a cell file describes; light to import."""

from dataclasses import replace

from touchgoal.control import features as ft
from touchgoal.control.cell.config import CameraSection, CellConfig
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import OptionError
from touchgoal.sim_envs.config import BeadMazeConfig, CameraPlacement, PickPlaceConfig, TaskConfig


def env_config_of(config: CellConfig) -> TaskConfig:
    """Return the task's options with the cell's sensors, at the rate of a deployment.

    UserError: an object or wire that does not exist.
    """
    try:
        task: TaskConfig = PickPlaceConfig(objects=config.task.objects)
        if config.task.simulated == "bead-maze":
            task = BeadMazeConfig(wires=config.task.wires)
    except OptionError as error:
        wrong = "; ".join(f"task.{key}: {what}" for key, what in error.problems)
        raise UserError(wrong) from error
    return replace(
        task,
        cameras=tuple(config.cameras),
        camera_size=ft.CAMERA_SHAPE[:2],
        tactile=config.fingertips is not None,
        sensor=config.sensor,
        control_hz=ft.CONTROL_HZ,
        front_camera=_placement(config.cameras.get("front")),
        wrist_camera=_placement(config.cameras.get("wrist")),
    )


def _placement(camera: CameraSection | None) -> CameraPlacement | None:
    """Return where the cell file says that a camera is; None if it does not."""
    if camera is None or camera.pose is None or camera.fovy is None:
        return None
    return (*camera.pose, camera.fovy)
