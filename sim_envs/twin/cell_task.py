"""The simulated task that a cell file describes; light to import."""

from dataclasses import replace

from touchgoal.control import features as ft
from touchgoal.control.cell.config import CellConfig
from touchgoal.sim_envs.config import BeadMazeConfig, PickPlaceConfig, TaskConfig


def env_config_of(config: CellConfig) -> TaskConfig:
    """Return the task's options with the cell's sensors, at the rate of a deployment."""
    task: TaskConfig = PickPlaceConfig(objects=config.task.objects)
    if config.task.simulated == "bead-maze":
        task = BeadMazeConfig(wires=config.task.wires)
    return replace(
        task,
        cameras=tuple(config.cameras),
        camera_size=ft.CAMERA_SHAPE[:2],
        tactile=config.fingertips is not None,
        sensor=config.sensor,
        control_hz=ft.CONTROL_HZ,
    )
