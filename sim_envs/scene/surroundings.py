"""Differences between the cell of an episode and the usual one: front camera, lamp, room light."""

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import Field

from touchgoal.runtime.option_types import checked_dataclass

Degrees = Annotated[float, Field(ge=-45, le=45)]
Metres = Annotated[float, Field(ge=-1, le=1)]
_MOST_TURN, _MOST_SHIFT, _MOST_LAMP = 7.0, 0.03, 1.0  # of `draw_surroundings`, degrees and m
_DIMMEST, _BRIGHTEST = 0.15, 2.0  # of `draw_surroundings`, shares of the usual light


@checked_dataclass
class Surroundings:
    """Changes of the front camera and of the light."""

    camera_turn: tuple[Degrees, Degrees] = (0.0, 0.0)
    """Turn of the front camera to its right and upwards, degrees."""
    camera_shift: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    """Shift of the front camera in the base frame, m."""
    lamp_shift: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    """Shift in the base frame of the lamp that casts shadows, m."""
    room_light: Annotated[float, Field(ge=-0.95, le=1)] = 0.0
    """Change of all light in the room, as a share; -0.8 dims it by 80 %."""


USUAL = Surroundings()


def draw_surroundings(rng: np.random.Generator) -> Surroundings:
    """Draw surroundings within 7 degrees, 3 cm, 1 m of the lamp, and 0.15 to 2 of the light."""
    yaw, pitch = rng.uniform(-_MOST_TURN, _MOST_TURN, 2)
    x, y, z = rng.uniform(-_MOST_SHIFT, _MOST_SHIFT, 3)
    a, b, c = rng.uniform(-_MOST_LAMP, _MOST_LAMP, 3)
    light = float(np.exp(rng.uniform(np.log(_DIMMEST), np.log(_BRIGHTEST)))) - 1
    return Surroundings((yaw, pitch), (x, y, z), (a, b, c), light)


@dataclass(frozen=True, eq=False)
class UsualScene:
    """Camera and lights of a compiled scene, from which surroundings differ."""

    eye: Float[np.ndarray, "3"]  # place of the front camera, m
    quat: Float[np.ndarray, "4"]  # its orientation, wxyz
    lens: float  # its vertical field of view, degrees
    lamp: Float[np.ndarray, "3"]  # place of the lamp that casts shadows, m
    light: tuple[Float[np.ndarray, "..."], ...]  # see `_light`

    @classmethod
    def of(cls, model: Any) -> "UsualScene":
        """Note those of an unchanged MjModel."""
        camera = model.camera("front")
        light = tuple(a.copy() for a in _light(model))
        lamp, lens = model.light_pos[0].copy(), float(camera.fovy[0])
        return cls(camera.pos.copy(), camera.quat.copy(), lens, lamp, light)

    def change(self, model: Any, surroundings: Surroundings) -> None:
        """Change the model; `surroundings` replace those of earlier calls."""
        import mujoco

        right, up = np.radians(surroundings.camera_turn)
        turn, camera = np.empty(4), model.camera("front")
        mujoco.mju_euler2Quat(turn, np.array([-right, up, 0]), "yxz")  # its x is right, y up
        mujoco.mju_mulQuat(camera.quat, self.quat, turn)
        camera.pos[:], camera.fovy[:] = self.eye + surroundings.camera_shift, self.lens
        model.light_pos[0] = self.lamp + surroundings.lamp_shift
        for now, usual in zip(_light(model), self.light, strict=True):
            now[:] = (1 + surroundings.room_light) * usual


def _light(model: Any) -> tuple[np.ndarray, ...]:
    """Return the arrays of the model that hold its brightness."""
    head = model.vis.headlight
    return model.light_diffuse, head.ambient, head.diffuse
