"""Differences between the light of an episode and the usual one: lamp and room."""

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import Field

from touchgoal.runtime.option_types import checked_dataclass

Metres = Annotated[float, Field(ge=-1, le=1)]
_MOST_LAMP = 1.0  # of `draw_lighting`, m
_DIMMEST, _BRIGHTEST = 0.15, 2.0  # of `draw_lighting`, shares of the usual light


@checked_dataclass
class Lighting:
    """Changes of the light."""

    lamp_shift: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    """Shift in the base frame of the lamp that casts shadows, m."""
    room_light: Annotated[float, Field(ge=-0.95, le=1)] = 0.0
    """Change of all light in the room, as a share; -0.8 dims it by 80 %."""


USUAL = Lighting()


def draw_lighting(rng: np.random.Generator) -> Lighting:
    """Draw the lamp within 1 m of its place along each axis, and 0.15 to 2 of the light."""
    x, y, z = rng.uniform(-_MOST_LAMP, _MOST_LAMP, 3)
    light = float(np.exp(rng.uniform(np.log(_DIMMEST), np.log(_BRIGHTEST)))) - 1
    return Lighting((x, y, z), light)


@dataclass(frozen=True, eq=False)
class UsualLight:
    """Lights of a compiled scene, from which a lighting differs."""

    lamp: Float[np.ndarray, "3"]  # place of the lamp that casts shadows, m
    light: tuple[Float[np.ndarray, "..."], ...]  # see `_light`

    @classmethod
    def of(cls, model: Any) -> "UsualLight":
        """Note those of an unchanged MjModel."""
        return cls(model.light_pos[0].copy(), tuple(a.copy() for a in _light(model)))

    def change(self, model: Any, lighting: Lighting) -> None:
        """Change the model; `lighting` replaces that of earlier calls."""
        model.light_pos[0] = self.lamp + lighting.lamp_shift
        for now, usual in zip(_light(model), self.light, strict=True):
            now[:] = (1 + lighting.room_light) * usual


def _light(model: Any) -> tuple[np.ndarray, ...]:
    """Return the arrays of the model that hold its brightness."""
    head = model.vis.headlight
    return model.light_diffuse, head.ambient, head.diffuse
