"""Pictures for people: the scene with the robot's full meshes, beside the touch pictures."""

from dataclasses import replace

import cv2
import mujoco
import numpy as np
from jaxtyping import UInt8

from touchgoal.sim_envs.cell.environment import FrankaTactileEnv
from touchgoal.sim_envs.scene.rendering import open_renderer

Picture = UInt8[np.ndarray, "_ _ 3"]  # pictures of different sizes meet in one call
_HEIGHT = 480


class SceneRecorder:
    """Films an environment after its reset: front camera left, the two sensors right.

    The full meshes (242k triangles) are drawn in a model of their own; the environment, its
    observations and its speed stay as they are.
    """

    def __init__(self, env: FrankaTactileEnv) -> None:
        self._env = env
        spec = env.scene(replace(env.config, meshes="full"))
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._renderer = open_renderer(self._model, _HEIGHT, _HEIGHT)
        self.frames: list[Picture] = []

    def capture(self) -> None:
        """Take and keep a picture of the environment as it is now."""
        self._data.qpos[:] = self._env.data.qpos
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, "front")
        scene = self._renderer.render()
        self.frames.append(scene_beside_touch(scene, [f.image for f in self._env.tactile_frames()]))

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()


def scene_beside_touch(scene: Picture, tactile: list[Picture]) -> Picture:
    """The scene with the tactile images, labelled, in a column right of it."""
    labelled = []
    for name, image in zip(("left", "right"), tactile, strict=False):
        image = image.copy()
        cv2.putText(
            image, name, (8, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 1, cv2.LINE_AA
        )
        labelled.append(image)
    return np.hstack([scene, np.vstack(labelled)]) if labelled else scene
