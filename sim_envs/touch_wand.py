"""The MMWand's bench as an environment: each step is one touch of an object with a wand.

A GelSight Mini and a load cell on a stick, a camera beside them, and three cameras over a green
bench (MMWand, section III). A real wand is held by hand; here its pose and force are given.
"""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Float, Float32, UInt8

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.control.wand_touch import CLIP, FORCE_RANGES, MAX_FORCE, VIEW_SHAPE, WandTouch
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Seed, checked_dataclass
from touchgoal.sim_envs.scene.contacts import PadContact
from touchgoal.sim_envs.scene.rendering import Renderer, open_renderer
from touchgoal.sim_envs.tactile.optics import render_untouched
from touchgoal.sim_envs.tactile.pad import TactileFrame, TactilePad
from touchgoal.sim_envs.tactile.sensor_instance import sample_instance
from touchgoal.sim_envs.wand.bench import VIEWS, Bench
from touchgoal.sim_envs.wand.objects import WandObject, find_wand_object, wand_objects

_AWAY = 0.09  # m from the surface, before contact
_LOWEST = np.radians(12)  # rad, lowest elevation of the approach over the bench
_TILT = 0.2  # how far the wand leans from the surface's normal towards its approach
_GRAZING = 0.3  # cosine between normal and approach below which the wand would slide off
_FEELER = 0.5  # N of the light touch that finds the object's place on the gel
_FOLLOWED = 0.7  # share of the way to the centre of that touch
_CASE = 0.014  # m from the gel's middle to the case's side
_PATCH = 0.015  # m, half the gel's diagonal


@checked_dataclass
class TouchWandConfig:
    """Options of the touch wand."""

    sensor: str = "gelsight_mini"
    """Sensor on the wand: a name (`touchgoal list sensors`) or the folder of a sensor file."""
    object: str | None = None
    """Object on the bench; drawn at each reset if none is given."""
    views: bool = True
    """Render the four cameras."""
    gel: Seed = 0
    """Number of the sensor instance on the wand; another number is another gel."""


@dataclass(frozen=True, eq=False)
class Touch(WandTouch):
    """One simulated touch."""

    # force (N) and torque (Nm) of the object on the gel at each image, sensor frame
    wrench: Float32[np.ndarray, "t 6"]


class TouchWand(gym.Env[dict[str, Any], np.ndarray]):
    """One object on a bench, touched once per step.

    ## Action space

    `Box(-1, 1, (6,))`: where and how the wand comes.

    | index | meaning | from -1 to 1 |
    |---|---|---|
    | 0 | azimuth of the approach | -180 to 180 degrees |
    | 1 | elevation of the approach | 12 to 90 degrees over the bench |
    | 2, 3 | its offset from the object's middle, across | the object's radius |
    | 4 | turn about the wand's axis | -180 to 180 degrees |
    | 5 | force | 0 to 20 N |

    The wand goes along the approach until it meets the object, and presses near the surface's
    normal there.

    ## Observation space

    `Dict`: four views `observation.images.<top, side_left, side_right, wand>` (224, 224, 3),
    `observation.images.tactile_left` and `observation.load` (N), at contact; after `reset`, before
    contact.

    ## Reward

    1 for a touch, 0 where the wand misses the object or cannot reach it.

    ## Episode end

    Truncated after 50 touches by the registered time limit.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 1}  # noqa: RUF012
    # From the first reset on: the scene, and the object on it.
    bench: Bench
    object: WandObject

    def __init__(
        self, config: TouchWandConfig | None = None, render_mode: str | None = None, **options: Any
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise UserError(f"render_mode is 'rgb_array' or none, not {render_mode!r}")
        self.config = config or TouchWandConfig(**options)
        self.render_mode = render_mode
        if self.config.object is not None:
            find_wand_object(self.config.object)
        self._sensor = find_sensor(self.config.sensor)
        self._instance = sample_instance(self._sensor, np.random.default_rng([self.config.gel, 17]))
        self.action_space = gym.spaces.Box(-1, 1, (6,), np.float32)
        self.observation_space = gym.spaces.Dict(self._spaces())
        self._renderer: Renderer | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Put an object on the bench; `options={"object": name}` chooses it."""
        super().reset(seed=seed)
        names = list(wand_objects())
        drawn = names[int(self.np_random.integers(len(names)))]
        name = (options or {}).get("object") or self.config.object or drawn
        if not hasattr(self, "object") or self.object.name != name:
            self._open(find_wand_object(name))
        self.move_object()
        bench = self.bench
        bench.place_wand(
            bench.centre + [0, 0, bench.radius + _AWAY], _axes(np.array([0.0, 0, 1]), 0)
        )
        return self._observe_untouched(), self._info(False)

    def step(
        self, action: Float[np.ndarray, "6"]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move the object a little, and touch it once."""
        self.move_object()
        touch = self.touch(np.asarray(action, float))
        if touch is None:
            return self._observe_untouched(), 0.0, False, False, self._info(False)
        observation = self._observation(touch.views, touch.clip[-1], float(touch.load[-1]))
        return observation, 1.0, False, False, self._info(True)

    def touch(self, action: Float[np.ndarray, "6"]) -> Touch | None:
        """Touch the object where it lies; None if the wand misses it or cannot reach it."""
        bench = self.bench
        towards, start = _approach(action, bench)
        met = bench.surface_along(start, towards)
        if met is None:
            return None
        point, normal = met
        lean = float(np.hypot(normal[0], normal[1]))
        if -normal @ towards < _GRAZING or point[2] < _CASE * lean:
            return None
        axis = normal - _TILT * (towards + normal)
        axis /= np.linalg.norm(axis)
        axes = _axes(axis, np.pi * action[4])
        tip = self._aim(point, axes)
        bench.place_wand(tip + _AWAY * axis, axes)
        before = self._render()
        bench.place_wand(tip, axes)
        force = (action[5] + 1) / 2 * MAX_FORCE
        forces = force * np.linspace(0, 1, CLIP)
        clip, wrench = self._press(tip, forces)
        return Touch(before, self._render(), clip, forces.astype(np.float32), wrench)

    def untouched(self, rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
        """Return the untouched gel's image, with the camera's noise drawn from `rng`."""
        return self._instance.with_dots(render_untouched(self._instance, rng))

    def random_action(self) -> Float[np.ndarray, "6"]:
        """Draw a touch as the paper's operator: anywhere, with a force from one of three ranges."""
        rng = self.np_random
        low, high = FORCE_RANGES[int(rng.integers(len(FORCE_RANGES)))]
        action = rng.uniform(-1, 1, 6)
        action[5] = 2 * rng.uniform(low, high) / MAX_FORCE - 1
        return action

    def render(self) -> UInt8[np.ndarray, "H W 3"]:
        """Return the view from the left."""
        return self._view("side_left")

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _spaces(self) -> dict[str, gym.Space]:
        shape = (*self._sensor.image_shape, 3)
        spaces: dict[str, gym.Space] = {
            ft.TACTILE_LEFT: gym.spaces.Box(0, 255, shape, np.uint8),
            ft.LOAD: gym.spaces.Box(0, MAX_FORCE, (1,), np.float32),
        }
        if self.config.views:
            view = gym.spaces.Box(0, 255, (*VIEW_SHAPE, 3), np.uint8)
            spaces |= {ft.IMAGE_PREFIX + name: view for name in VIEWS}
        return spaces

    def _open(self, wand_object: WandObject) -> None:
        """Build another object's scene."""
        self.close()
        self.bench, self.object = Bench(wand_object, VIEW_SHAPE), wand_object
        model, bodies = self.bench.model, self.bench.bodies
        self._pad = TactilePad(model, "left", self._sensor, self._instance, bodies)
        if self.config.views or self.render_mode:
            self._renderer = open_renderer(model, *VIEW_SHAPE)

    def move_object(self) -> None:
        """Move and turn the object on the bench at random, as the paper's operator before each touch."""
        x, y = self.np_random.uniform(-0.03, 0.03, 2)
        self.bench.place_object(x, y, self.np_random.uniform(-np.pi, np.pi))

    def _press(
        self, point: Float[np.ndarray, "3"], forces: Float[np.ndarray, " t"]
    ) -> tuple[UInt8[np.ndarray, "t h w 3"], Float32[np.ndarray, "t 6"]]:
        """Press with rising forces (N) where the wand is; return images and wrenches."""
        geoms = self.bench.geoms_near(point, _PATCH)
        frames = [self._sense(force, geoms, self.np_random) for force in forces]
        fields = [frame.field for frame in frames]
        wrenches = [np.zeros(6) if field is None else field.wrench() for field in fields]
        return np.stack([frame.image for frame in frames]), np.array(wrenches, np.float32)

    def _sense(self, force: float, geoms: frozenset[int], rng: np.random.Generator) -> TactileFrame:
        contact = PadContact(np.array([0, 0, -force]), np.zeros(3), 0.0, geoms)
        return self._pad.sense(self.bench.data, contact, rng)

    def _aim(
        self, point: Float[np.ndarray, "3"], axes: Float[np.ndarray, "3 3"]
    ) -> Float[np.ndarray, "3"]:
        """Return where to put the gel's middle: most of the way to the centre of a light touch."""
        tip = point
        for _ in range(2):
            self.bench.place_wand(tip, axes)
            geoms = self.bench.geoms_near(tip, _PATCH)
            field = self._sense(_FEELER, geoms, np.random.default_rng(0)).field
            if field is None or not field.normal.any():
                break
            rows, columns = np.indices(field.normal.shape) * field.pitch
            load = field.normal / field.normal.sum()
            x = float((load * (columns - columns.mean())).sum())
            y = float((load * (rows - rows.mean())).sum())
            tip = tip + _FOLLOWED * (x * axes[:, 0] + y * axes[:, 1])
        return tip

    def _render(self) -> dict[str, UInt8[np.ndarray, "H W 3"]]:
        return {name: self._view(name) for name in VIEWS} if self.config.views else {}

    def _view(self, name: str) -> UInt8[np.ndarray, "H W 3"]:
        assert self._renderer is not None
        self._renderer.update_scene(self.bench.data, name, self.bench.shown)
        return self._renderer.render()

    def _observation(
        self,
        views: dict[str, UInt8[np.ndarray, "H W 3"]],
        image: UInt8[np.ndarray, "h w 3"],
        load: float,
    ) -> Observation:
        observation = {ft.IMAGE_PREFIX + name: view for name, view in views.items()}
        return observation | {ft.TACTILE_LEFT: image, ft.LOAD: np.array([load], np.float32)}

    def _observe_untouched(self) -> Observation:
        clip, _ = self._press(np.zeros(3), np.zeros(1))
        return self._observation(self._render(), clip[-1], 0.0)

    def _info(self, touched: bool) -> dict[str, Any]:
        return {ft.TRUTH_CONTACT: np.array([touched, False]), "object": self.object.name}


def _approach(
    action: Float[np.ndarray, "6"], bench: Bench
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return the direction in which the wand comes, and where its ray starts, bench frame."""
    azimuth = np.pi * action[0]
    elevation = _LOWEST + (action[1] + 1) / 2 * (np.pi / 2 - _LOWEST)
    c, s = np.cos(elevation), np.sin(elevation)
    away = np.array([c * np.cos(azimuth), c * np.sin(azimuth), s])
    across = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    offset = bench.radius * (action[2] * across + action[3] * np.cross(away, across))
    return -away, bench.centre + 2 * bench.radius * away + offset


def _axes(axis: Float[np.ndarray, "3"], turn: float) -> Float[np.ndarray, "3 3"]:
    """Return a sensor frame whose z (out of the gel) goes against `axis`, turned about it (rad)."""
    z = -axis
    side = np.cross(z, [0.0, 1, 0] if abs(z[1]) < 0.9 else [1.0, 0, 0])
    side /= np.linalg.norm(side)
    other = np.cross(z, side)
    x = np.cos(turn) * side + np.sin(turn) * other
    return np.stack([x, np.cross(z, x), z], axis=1)
