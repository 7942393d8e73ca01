"""Options of the simulated cell and of each task; light to import."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, Field

from touchgoal.control import features as ft
from touchgoal.runtime.errors import unknown_name
from touchgoal.runtime.option_types import (
    FIXED,
    ORDERED,
    RARE,
    Count,
    Fraction,
    NotNegative,
    Positive,
    checked_dataclass,
)
from touchgoal.sim_envs.cell.deployment import DeploymentConfig
from touchgoal.sim_envs.scene.lighting import USUAL, Lighting
from touchgoal.sim_envs.scene.objects import CATALOGUE, find_object
from touchgoal.sim_envs.scene.wires import (
    PER_FAMILY,
    TRAINED,
    Family,
    Split,
    Wire,
    choose,
    find_wire,
)

Outcome = Literal[
    "success",
    "slow",
    "regrasped",
    "never_touch",
    "never_lifted",
    "freeze",
    "freeze_holding",
    "drop",
    "released_early",
    "off",
    "slip",
    "edge_grasp",
    "pressed",
    "overgripped",
    "wrong_object",
    "same_shape",
]
"""How an expert of pick-place ends.

success; two poorer successes: slow (at half the speed) and regrasped (put down and grasped anew);
and thirteen failures: never_touch (closes 8 cm above the object), never_lifted (grasped, and held
on the table), freeze (stops before the touch), freeze_holding (stops on the way), drop (lets go on
the way), released_early (lets go 4 cm before the goal and above the table), off (placed 2.5 to 3 cm
beside the goal), slip (slides down in the hand and is held again), edge_grasp (held at its edge), pressed (pushed on
into the table), overgripped (40 N), wrong_object (takes a distractor), same_shape (the object on
the table has another material than the one asked for). By its place alone a slip, an edge_grasp or
an overgripped object can still be a success of the task.
"""
TaskName = Literal["pick-place", "bead-maze", "fragile-carry"]
Camera = Literal["front", "wrist"]
ObjectName = Annotated[str, AfterValidator(lambda name: find_object(name).name)]
"""A name of the catalogue of objects, or the mesh file of one's own."""
WireName = Annotated[str, AfterValidator(lambda name: find_wire(name).name)]
"""A name such as helix-1."""
Force = Annotated[float, Field(gt=0, le=40.0, allow_inf_nan=False)]
"""N of each finger; the simulated gripper presses with 40 N at most."""
ForceRange = Annotated[tuple[Force, Force], ORDERED]
Mass = Annotated[float, Field(ge=0.001, le=3.0, allow_inf_nan=False)]
"""kg; lighter objects shake in the solver; 3 kg is the payload in the FR3 data sheet."""
Friction = Annotated[float, Field(gt=0, le=2.0, allow_inf_nan=False)]
MAX_CAMERA_SIDE = 1280
"""Rows or columns of the largest camera image, px."""
Pixels = Annotated[int, Field(ge=16, le=MAX_CAMERA_SIDE, multiple_of=2)]
"""Rows or columns of a camera image; recorded video needs even ones."""

SETPOINT_PERIOD = 0.002
"""s between the set-points that divide a control tick; coarser ones shake the wrist."""

STREAM_SIZE = (256, 256)
"""Rows and columns of a twin's camera streams, px."""


@checked_dataclass
class SensorRandomization:
    """Differences between two fingertip sensors of one model.

    Brightness: measured on real Minis (Tactile-MNIST: gain std 0.047 across sensors; offset std
    0.0094 and smooth pattern std 0.0093 of full scale; noise of the channels correlated by 0.24 to
    0.39). The others: differences between published calibrations.
    """

    # Standard deviation of each colour channel's.
    gain: Annotated[NotNegative, Field(le=0.3)] = 0.047
    # Standard deviations of a constant and of a smooth pattern added to the untouched image, of 255.
    offset: NotNegative = 2.4
    pattern: NotNegative = 2.4
    azimuth: Annotated[NotNegative, Field(le=180)] = 15.0  # largest turn of each light, degrees
    blur: Fraction = 0.3  # largest relative change of the gel's smoothing of an imprint
    pixel_pitch: bool = True  # draw the millimetres per pixel from the sensor model's range
    # Share of the model's largest blur by the lens, from which it is drawn.
    defocus: Fraction = 1.0
    # Largest shift of dots, share of their spacing, and change of their size.
    markers: Fraction = 0.1


NO_RANDOMIZATION = SensorRandomization(
    gain=0.0, offset=0.0, pattern=0.0, azimuth=0.0, blur=0.0,
    pixel_pitch=False, defocus=0.0, markers=0.0,
)  # fmt: skip


CameraPlacement = tuple[float, float, float, float, float, float, float, float]
"""Place (x, y, z, m), orientation (quaternion wxyz; z looks ahead, y down) and vertical field of view
(degrees) of a camera."""
USUAL_CAMERA: CameraPlacement = (1.15, 0.0, 0.55, -0.336798, 0.621745, 0.621745, -0.336798, 40.0)
"""The front camera unless `front_camera` says otherwise, in the base frame."""


@checked_dataclass
class SceneConfig:
    """Options of the scene."""

    sensor: str = "gelsight_mini"
    """Sensor on both fingertips: a name (`touchgoal list sensors`) or the folder of a sensor file
    from `touchgoal calibrate`."""
    arm: Literal["fr3", "ur5e"] = "fr3"
    """Arm that carries the hand."""
    meshes: Annotated[Literal["fast", "full"], FIXED] = "fast"
    """Meshes of the arm in camera images: collision meshes (fast: 2,500 triangles, 1 ms per frame in
    software OpenGL) or visual meshes true to 2 mm, with shadow and antialiasing (full: 72,000
    triangles, 40 ms)."""
    front_camera: Annotated[CameraPlacement | None, RARE] = None
    """The front camera as calibrate-camera measured yours, in the base frame: x y z (m), quaternion wxyz (z
    looks ahead, y down), vertical field of view (degrees)."""
    wrist_camera: Annotated[CameraPlacement | None, RARE] = None
    """The same of the wrist camera, in the hand frame."""


def _one_or_three(changes: tuple[float, ...]) -> tuple[float, ...]:
    if len(changes) not in (1, 3):
        raise ValueError(f"takes one value, or red, green and blue, not {len(changes)} values")
    return changes


BrightnessChange = Annotated[float, Field(ge=-0.95, le=1.0)]
"""As a share of the brightness; -0.15 is 15 % dimmer."""
LightChange = Annotated[tuple[BrightnessChange, ...], AfterValidator(_one_or_three)]
"""Change of each colour channel's brightness as a share; one value for all three."""


@checked_dataclass
class EnvConfig(SceneConfig):
    """Options of every task."""

    cameras: tuple[Camera, ...] = ("front", "wrist")
    """Observed cameras; fewer is faster."""
    camera_size: tuple[Pixels, Pixels] = ft.CAMERA_SHAPE[:2]
    """Rows and columns of camera images, px; both even."""
    tactile: bool = True
    """Observe the tactile images of both fingertips."""
    control_hz: Annotated[Count, RARE] = ft.CONTROL_HZ
    """Control ticks per second; a divisor of 500."""
    max_seconds: Positive = 8.0
    """Time limit of an episode, s."""
    rest: Annotated[NotNegative, FIXED] = 0.0
    """Time recorded after an episode's end, in which the hand holds still, s."""
    ends_by_success: Annotated[bool, FIXED] = True
    """End an episode at success; without, it goes on, as where nobody knows."""
    disturbance: Annotated[NotNegative, Field(le=0.1)] = 0.0
    """Random hand motion added to each action, so that demonstrations show recoveries (DART, Laskey
    2017): RMS speed along each axis, m/s. The hand also turns, at 2 rad/s (in bead-maze 20 rad/s) per
    m/s; in fragile-carry the squeeze varies, too."""
    randomization: Annotated[SensorRandomization, FIXED] = SensorRandomization()
    """Differences between the two fingertip sensors, drawn for each episode."""
    light_change: Annotated[LightChange, FIXED] = (0.0,)
    """Change of the fingertips' light after an episode's first image, as a share: one value, or
    red, green and blue. -0.15 dims them by 15 %."""
    lighting: Annotated[Lighting, FIXED] = USUAL
    """Changes of the light in the room."""
    as_deployed: bool = False
    """Simulate the delays, limits and measurement errors of an arm driven by `deploy`."""
    deployment: DeploymentConfig = DeploymentConfig()
    """Delays with `--env.as-deployed`."""

    def reset_options(self, count: int | None = None) -> list[dict[str, Any]]:
        """Return options of `reset` for episodes to take in turn, `count` of them if it matters."""
        return [{}]

    def __post_init__(self) -> None:
        """Raise ValueError if a tick is no whole number of set-points, an episode has none, or delays
        are given that would do nothing."""
        setpoints = 1 / self.control_hz / SETPOINT_PERIOD
        if round(setpoints) < 1 or abs(setpoints - round(setpoints)) >= 1e-6:
            raise ValueError(
                f"control_hz is {self.control_hz}; it must divide 500 (10, 20, 25, 50, 100, ...), "
                "because set-points come every 2 ms"
            )
        if self.deployment != DeploymentConfig() and not self.as_deployed:
            raise ValueError("deployment has delays, which need as_deployed (--env.as-deployed)")
        if self.max_seconds * self.control_hz < 1:
            raise ValueError(f"max_seconds must be at least a tick of 1/{self.control_hz} s")


@checked_dataclass
class PickPlaceConfig(EnvConfig):
    """Options of pick-place; reset's `options` override the random draws."""

    objects: tuple[ObjectName, ...] = ()
    """Objects to draw from (`touchgoal list objects`), or mesh files of your own (.stl, .obj);
    default: all."""
    distractors: Annotated[int, Field(ge=0, le=4)] = 0
    """Number of other objects on the table."""
    mass: Annotated[tuple[Mass, Mass], ORDERED] = (0.02, 0.2)
    """Range of the object's mass, kg."""
    grasp_force: ForceRange = (5.0, 30.0)
    """Range of the force of each finger, N."""
    # Largest distance of the placed object's centre from the goal, m.
    tolerance: Annotated[float, Field(gt=0, le=0.1, allow_inf_nan=False), FIXED] = 0.02
    size_factor: Annotated[Positive, FIXED] = 1.0  # of the objects
    friction_factor: Annotated[Positive, FIXED] = 1.0  # of the objects
    nudge: Annotated[NotNegative, FIXED] = 0.0  # m by which the object moves after a second
    # taken: it is gone once the hand is over it; knocked: on the table, 7 cm aside, once it is lifted by 5 cm
    interference: Annotated[Literal["", "taken", "knocked"], FIXED] = ""
    release: bool = False
    """Success also requires that the hand lets go. The paper's reward curves end in touch, so by
    default an episode ends with the placed object still in the hand."""

    def reset_options(self, count: int | None = None) -> list[dict[str, Any]]:
        """Return each object once."""
        return [{"object": name} for name in self.objects or CATALOGUE]


Place = tuple[Annotated[float, Field(ge=0.3, le=0.7)], Annotated[float, Field(ge=-0.3, le=0.3)]]
"""x and y on the table, m, base frame."""


@checked_dataclass
class PickPlaceReset:
    """Options of `PickPlace.reset`, each in place of a random draw."""

    object: ObjectName | None = None
    """Name from the catalogue (`touchgoal list objects`)."""
    mass: Mass | None = None
    """Mass of the object, kg."""
    grasp_force: Force | None = None
    """Force of each finger, N."""
    asked: ObjectName | None = None
    """Object that the instruction asks for, while another lies on the table; placing that other one
    is no success."""
    start: Place | None = None
    """Where the object starts, m, base frame."""
    goal: Place | None = None
    """Where to place the object, m, base frame."""


@checked_dataclass
class BeadMazeConfig(EnvConfig):
    """Options of bead-maze; reset's `options` override the random draws."""

    sensor: str = "gelsight_mini_markers"
    """Sensor on both fingertips: a name (`touchgoal list sensors`) or the folder of a sensor file
    from `touchgoal calibrate`. Only a gel with printed dots shows shear well."""
    cameras: tuple[Camera, ...] = ()
    """Observed cameras; fewer is faster."""
    max_seconds: Positive = 40.0
    """Time limit of an episode, s."""
    wires: tuple[WireName, ...] = ()
    """Wires to draw from, such as helix-1; default: the first `n-wires` of `split`."""
    split: Split = "training"
    """Set of wires to draw from; the sets are disjoint."""
    families: Annotated[tuple[Family, ...], FIXED] = TRAINED  # of wires to draw from
    n_wires: Count | None = None
    """Number of wires to draw from; default: 200, or all if the split has fewer."""
    bead: Literal["sphere", "cylinder"] = "sphere"
    """Shape of the bead; the wire exerts a torque on a cylinder, hardly on a sphere."""
    grasp_force: ForceRange = (8.0, 12.0)
    """Range of the force of each finger, N."""
    start_angle: Annotated[NotNegative, Field(le=45)] = 0.0
    """Largest angle between hand and wire at the start, degrees."""
    # Of the bead on the wire.
    wire_friction: Annotated[tuple[Friction, Friction], ORDERED, FIXED] = (0.15, 0.25)
    stall_seconds: Annotated[Positive, FIXED] = 5.0  # s without 2 mm of progress: jammed

    def chosen_wires(self, count: int | None = None) -> list[Wire]:
        """Return the wires to draw from, or `count` of them; named wires repeat in turn."""
        if not self.wires:
            most = min(200, PER_FAMILY[self.split] * len(self.families))
            return choose(self.split, count or self.n_wires or most, self.families)
        named = [find_wire(name) for name in self.wires]
        return named if count is None else [named[i % len(named)] for i in range(count)]

    def reset_options(self, count: int | None = None) -> list[dict[str, Any]]:
        """Return one wire for each episode."""
        return [{"wire": wire.name} for wire in self.chosen_wires(count)]


@checked_dataclass
class BeadMazeReset:
    """Options of `BeadMaze.reset`, each in place of a random draw."""

    wire: WireName | None = None
    """Name such as helix-1."""
    grasp_force: Force | None = None
    """Force of each finger, N."""


@checked_dataclass
class FragileCarryConfig(EnvConfig):
    """Options of fragile-carry; reset's `options` override the random draws."""

    sensor: str = "gelsight_mini_markers"
    """Sensor on both fingertips: a name (`touchgoal list sensors`) or the folder of a sensor file
    from `touchgoal calibrate`."""
    cameras: tuple[Camera, ...] = ()
    """Observed cameras; fewer is faster."""
    mass: Annotated[tuple[Mass, Mass], ORDERED] = (0.1, 0.15)
    """Range of the rod's mass, kg; the friction follows from it and the force that holds."""


@checked_dataclass
class FragileCarryReset:
    """Options of `FragileCarry.reset`, each in place of a random draw."""

    hold_force: Force | None = None
    """Force of each finger that just holds the rod, N."""
    mass: Mass | None = None
    """Mass of the rod, kg."""


TaskConfig = PickPlaceConfig | BeadMazeConfig | FragileCarryConfig
ENVS: dict[TaskName, TaskConfig] = {
    "pick-place": PickPlaceConfig(),
    "bead-maze": BeadMazeConfig(split="validation"),
    "fragile-carry": FragileCarryConfig(),
}
"""Environments in which policies are tried."""
TASKS: dict[TaskName, type[TaskConfig]] = {name: type(config) for name, config in ENVS.items()}


def task_name(config: EnvConfig) -> TaskName:
    """Return the commands' name of a config's task."""
    return next(name for name, kind in TASKS.items() if isinstance(config, kind))


Config = TypeVar("Config")


def with_options(config: Config, options: Mapping[str, Any]) -> Config:
    """Return the config with the fields named in `options` replaced.

    UserError: there is no such field, or a value is out of its range.

    Args:
        options: new values by field name; for a nested config (`randomization`), a config or a
            mapping of its fields that change.
    """
    assert is_dataclass(config) and not isinstance(config, type)
    names = [field.name for field in fields(config)]
    changes = {}
    for name, value in options.items():
        if name not in names:
            raise unknown_name(f"option of {type(config).__name__}", name, names)
        current = getattr(config, name)
        nested = is_dataclass(current) and isinstance(value, Mapping)
        changes[name] = with_options(current, value) if nested else value
    return replace(config, **changes)
