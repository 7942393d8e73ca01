"""Films of an environment: the scene with the robot's full meshes, beside the tactile images."""

from dataclasses import replace
from typing import Literal

import cv2
import mujoco
import numpy as np
from jaxtyping import UInt8

from touchgoal.sim_envs.cell.environment import FrankaTactileEnv
from touchgoal.sim_envs.scene.rendering import open_renderer

TICKS_PER_IMAGE = 2
_HEIGHT = 240  # px


class SceneRecorder:
    """Films an environment after its reset: front camera left, both tactile images right.

    The scene is drawn in a model of its own: the environment does not change.
    """

    def __init__(self, env: FrankaTactileEnv, meshes: Literal["fast", "full"] = "full") -> None:
        """Film with full meshes and shadows, or much faster without (see `SceneConfig.meshes`)."""
        self._env = env
        spec = env.scene(replace(env.config, meshes=meshes))
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._renderer = open_renderer(self._model, _HEIGHT, _HEIGHT)
        self._ticks = 0
        self._images: list[np.ndarray] = []

    def capture(self) -> None:
        """Film a tick; every second call draws an image."""
        self._ticks += 1
        if self._ticks % TICKS_PER_IMAGE != 1:
            return
        self._data.qpos[:] = self._env.data.qpos
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, "front")
        touch = [frame.image for frame in self._env.tactile_frames]
        self._images.append(_beside(self._renderer.render(), touch))

    @property
    def images(self) -> UInt8[np.ndarray, "n h w 3"]:
        """The images so far, one every `TICKS_PER_IMAGE` ticks."""
        return np.stack(self._images)

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()


def _beside(scene: np.ndarray, tactile: list[np.ndarray]) -> np.ndarray:
    column = []
    for name, image in zip(("left", "right"), tactile, strict=False):
        small = cv2.resize(image, (2 * _HEIGHT // 3, _HEIGHT // 2), interpolation=cv2.INTER_AREA)
        font, white = cv2.FONT_HERSHEY_SIMPLEX, (255, 255, 255)
        cv2.putText(small, name, (5, 13), font, 0.4, white, 1, cv2.LINE_AA)
        column.append(small)
    return np.hstack([scene, np.vstack(column)]) if column else scene
