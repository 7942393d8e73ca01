"""Observation and action spaces of an environment."""

from typing import Any

import gymnasium as gym
import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.safety.limits import RobotLimits
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.sim_envs.config import EnvConfig


def observation_space(config: EnvConfig, joints: int, sensor: SensorModel) -> gym.spaces.Dict:
    """Return the space of an arm with `joints` joints, the observed cameras and the fingertips."""
    of_arm = ft.features_of(joints)
    spaces: dict[str, gym.Space[Any]] = {
        key: gym.spaces.Box(-np.inf, np.inf, of_arm[key].shape, np.float32)
        for key in (ft.STATE, ft.COMMAND, ft.TCP_POSE, ft.WRENCH)
    }
    for camera in config.cameras:
        spaces[ft.IMAGE_PREFIX + camera] = _pictures((*config.camera_size, 3))
    for key in ft.TACTILE if config.tactile else ():
        spaces[key] = _pictures((*sensor.image_shape, 3))
    return gym.spaces.Dict(spaces)


def action_space(robot: RobotLimits, hz: int) -> gym.spaces.Box:
    """Return the space of joint changes (rad) in one tick, and gripper widths (m)."""
    step = robot.hardware.velocity / hz
    return gym.spaces.Box(
        np.append(-step, 0.0).astype(np.float32),
        np.append(step, robot.tool.stroke[1]).astype(np.float32),
        dtype=np.float32,
    )


def _pictures(shape: tuple[int, ...]) -> gym.spaces.Box:
    return gym.spaces.Box(0, 255, shape, np.uint8)
