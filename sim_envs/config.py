"""Options of the simulated cell and of each task; light to import, for every command shows them."""

from dataclasses import replace
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from touchgoal.control import features as ft
from touchgoal.runtime.option_types import (
    ORDERED,
    RARE,
    Count,
    Fraction,
    NotNegative,
    Positive,
    PositiveRange,
    Seed,
    checked_dataclass,
)
from touchgoal.sim_envs.scene.objects import find as find_object
from touchgoal.sim_envs.scene.wires import PER_FAMILY, TRAINED, Family, Split, Wire, choose
from touchgoal.sim_envs.scene.wires import find as find_wire

Outcome = Literal["success", "never_touch", "drop", "wrong_object", "freeze"]
"""How an expert of pick-place ends: it succeeds, or fails in one of four ways."""
TaskName = Literal["pick-place", "bead-maze"]
Camera = Literal["front", "wrist"]
Indenter = Literal["sphere", "sharp", "flat"]
"""A probe of the indenter rig."""
ObjectName = Annotated[str, AfterValidator(lambda name: find_object(name).name)]
"""A name of the catalogue of objects."""
WireName = Annotated[str, AfterValidator(lambda name: find_wire(name).name)]
"""A name such as helix-1."""
Force = Annotated[Positive, Field(le=40.0)]
"""Of each finger, N; the simulated gripper presses with 40 N at most."""
ForceRange = Annotated[tuple[Force, Force], ORDERED]
Mass = Annotated[Positive, Field(ge=0.001, le=3.0)]
"""kg: lighter objects shake in the solver, heavier ones are beyond what an FR3 carries."""
Friction = Annotated[Positive, Field(le=2.0)]
Pixels = Annotated[int, Field(ge=16, multiple_of=2)]
"""Rows or columns of a camera's picture; recorded video needs even ones."""

MAX_CAMERA_SIZE = (960, 1280)
"""Rows and columns of the largest picture that the scene renders, px."""
SETPOINT_PERIOD = 0.002
"""s between the set-points that a control tick is divided into: coarser ones shake the wrist."""

STREAM_SIZE = (256, 256)
"""Rows and columns of what a twin's cameras send, more than is recorded."""


@checked_dataclass
class SensorRandomization:
    """How much two fingertip sensors of one model differ.

    Brightness: measured over real Minis (Tactile-MNIST: per-unit gain std 0.047; offset std 0.0094
    and smooth pattern std 0.0093 of full scale; channels' noise correlated by 0.24 to 0.39). The
    others: the differences between published calibrations.
    """

    gain: Annotated[NotNegative, Field(le=0.3)] = 0.047
    """Standard deviation of each colour channel's brightness, as a share of it."""
    offset: NotNegative = 2.4
    """Standard deviation of a constant added to the untouched picture, counts of 255."""
    pattern: NotNegative = 2.4
    """Standard deviation of a smooth pattern added to the untouched picture, counts of 255."""
    azimuth: Annotated[NotNegative, Field(le=180)] = 15.0
    """Largest turn of each light around the gel, degrees."""
    blur: Fraction = 0.3
    """Largest change of how far the gel smooths an imprint, as a share of it."""
    pixel_pitch: bool = True
    """Draw the millimetres per pixel from the range of the sensor model."""
    markers: Fraction = 0.1
    """Largest shift of printed dots (share of their distance) and change of their size (share)."""


NO_RANDOMIZATION = SensorRandomization(
    gain=0.0, offset=0.0, pattern=0.0, azimuth=0.0, blur=0.0, pixel_pitch=False, markers=0.0
)


@checked_dataclass
class SceneConfig:
    """What the scene is made of."""

    sensor: str = "gelsight_mini"
    """Sensor on both fingertips: a name (`touchgoal list sensors`), or the folder of a sensor file
    that `touchgoal calibrate` wrote."""
    arm: Literal["fr3", "ur5e"] = "fr3"
    """Arm that carries the hand."""
    meshes: Annotated[Literal["fast", "full"], RARE] = "fast"
    """What cameras see of the arm: its collision meshes (fast: 2,500 triangles, 1 ms a frame in
    software OpenGL) or its visual ones (full: 242,000 triangles, 30 ms)."""
    timestep: Annotated[Positive, RARE] = 1e-3
    """Time step of the physics, s; 2 ms is a whole number of them."""

    def __post_init__(self) -> None:
        """Raises ValueError if set-points would not fall on steps of the physics."""
        if not _is_multiple(SETPOINT_PERIOD, self.timestep):
            raise ValueError(
                f"timestep must divide 2 ms (0.002, 0.001, 0.0005, ...), not {self.timestep:g}"
            )


Delay = Annotated[float, Field(ge=0.0, le=0.2)]
"""s"""
DelayRange = Annotated[tuple[Delay, Delay], ORDERED]
TickRange = Annotated[tuple[Annotated[int, Field(ge=0, le=2)], ...], Field(min_length=1)]


def _one_or_three(changes: tuple[float, ...]) -> tuple[float, ...]:
    if len(changes) not in (1, 3):
        raise ValueError(f"takes one value, or red, green and blue, not {len(changes)} values")
    return changes


BrightnessChange = Annotated[float, Field(ge=-0.95, le=1.0)]
"""As a share of the brightness; -0.15 is 15 % dimmer."""
LightChange = Annotated[tuple[BrightnessChange, ...], AfterValidator(_one_or_three)]
"""Change of each colour channel's brightness as a share; one value for all three."""


@checked_dataclass
class DeploymentConfig:
    """Delays and dynamics of a real arm, drawn anew for each episode.

    What is not given follows `as_deployed`: all of it as over the wire (`AS_DEPLOYED`), or none.
    """

    tracker: bool | None = None
    """The arm is driven as `deploy` drives it: the lag of deploy's loop, the safety layer's limits,
    the 1 kHz tracker, and an arm that follows its set-point without a lag of its own."""
    franka_hand: bool | None = None
    """The hand is a Franka Hand: one command at a time, each runs to its end; closing to 0 grasps
    what it meets, any other width is a move. Its width is read every 50 ms."""
    estimated_wrench: bool | None = None
    """The force on the hand is a real arm's estimate: with noise, bias, drift and lag."""
    state_delay: DelayRange | None = None
    """Age of joint positions, velocities and force when the policy sees them, s."""
    picture_delay: DelayRange | None = None
    """Age of the pictures of cameras and fingertips when the policy sees them, s."""
    picture_rate: Annotated[float, Field(ge=5, le=1000)] | None = None
    """Pictures a second that cameras and fingertips take, Hz: between two of them the last is seen."""
    command_delay: DelayRange | None = None
    """From the policy's answer until arm and hand get it, s."""
    jitter: DelayRange | None = None
    """How much each of these delays varies from tick to tick: up to so much is added, s."""
    plan_ticks: TickRange | None = None
    """Control ticks by which a learned policy's plans come late: one of these."""
    force_ceiling: bool | None = None
    """An episode ends, failed, once the force on the hand is above the task's ceiling, at which
    `deploy` stops the arm."""


IDEAL_DEPLOYMENT = DeploymentConfig(
    tracker=False,
    franka_hand=False,
    estimated_wrench=False,
    state_delay=(0.0, 0.0),
    picture_delay=(0.0, 0.0),
    picture_rate=1000.0,
    command_delay=(0.0, 0.0),
    jitter=(0.0, 0.0),
    plan_ticks=(0,),
    force_ceiling=False,
)
# Measured on the wire (touchgoal benchmark deploy, replay): a state is 7 to 18 ms old, commands take 20 to
# 25 ms of which the tracker has its share; fingertips and cameras send 25 to 30 pictures a second; a
# plan is asked for a tick early.
AS_DEPLOYED = DeploymentConfig(
    tracker=True,
    franka_hand=True,
    estimated_wrench=True,
    state_delay=(0.005, 0.02),
    picture_delay=(0.005, 0.02),
    picture_rate=30.0,
    command_delay=(0.005, 0.02),
    jitter=(0.0, 0.02),
    plan_ticks=(1,),
    force_ceiling=True,
)


@checked_dataclass
class EnvConfig(SceneConfig):
    """Options every task has."""

    cameras: tuple[Camera, ...] = ("front", "wrist")
    """Cameras that are observed; fewer is faster."""
    camera_size: tuple[
        Annotated[Pixels, Field(le=MAX_CAMERA_SIZE[0])],
        Annotated[Pixels, Field(le=MAX_CAMERA_SIZE[1])],
    ] = ft.CAMERA_SHAPE[:2]
    """Rows and columns of the cameras' pictures, px."""
    tactile: bool = True
    """Observe the pictures of both fingertips."""
    control_hz: Annotated[Count, RARE] = ft.CONTROL_HZ
    """Control ticks per second; a divisor of 500."""
    max_seconds: Positive = 8.0
    """Length after which an episode ends, s."""
    disturbance: Annotated[NotNegative, Field(le=0.1)] = 0.0
    """Random motion added to what is commanded, so that an expert shows how to come back (DART,
    Laskey 2017): rms speed along each axis, m/s. For each m/s the hand also turns, by 2 rad/s in
    pick-place and 20 rad/s in bead-maze, whose bead turns with it."""
    randomization: Annotated[SensorRandomization, RARE] = SensorRandomization()
    """How much the two fingertip sensors differ, drawn anew for each episode."""
    light_change: Annotated[LightChange, RARE] = (0.0,)
    """Change of the fingertips' light after an episode's first picture, as a share: one value, or
    red, green and blue. -0.15 dims them by 15 %."""
    as_deployed: bool = False
    """Behave as the arm does when it is deployed: driven, delayed and sensed as over the wire."""
    deployment: DeploymentConfig = DeploymentConfig()
    """Overrides of single as-deployed settings."""

    def resolved_deployment(self) -> DeploymentConfig:
        """What lies between policy and arm, every field of it given."""
        base = AS_DEPLOYED if self.as_deployed else IDEAL_DEPLOYMENT
        own = {name: value for name, value in vars(self.deployment).items() if value is not None}
        return replace(base, **own)

    def __post_init__(self) -> None:
        """Raises ValueError if a tick is no whole number of set-points, or an episode has none."""
        super().__post_init__()
        if not _is_multiple(1 / self.control_hz, SETPOINT_PERIOD):
            raise ValueError(
                "control_hz must divide 500, for set-points come every 2 ms (10, 20, 25, 50, 100, "
                f"...), not {self.control_hz}"
            )
        if self.resolved_deployment() != IDEAL_DEPLOYMENT and not _is_multiple(1e-3, self.timestep):
            raise ValueError(
                f"as deployed, time goes by in ms: timestep 0.001, not {self.timestep:g}"
            )
        if self.max_seconds * self.control_hz < 1:
            raise ValueError(f"max_seconds must be at least a tick of 1/{self.control_hz} s")


@checked_dataclass
class PickPlaceConfig(EnvConfig):
    """Options of pick-place; reset's `options` override the random draws."""

    objects: tuple[ObjectName, ...] = ()
    """Objects to draw from (`touchgoal list objects`); default: all."""
    distractors: Annotated[int, Field(ge=0, le=4)] = 0
    """Other objects on the table."""
    mass: Annotated[tuple[Mass, Mass], ORDERED] = (0.02, 0.2)
    """Lightest and heaviest object, kg."""
    grasp_force: ForceRange = (5.0, 30.0)
    """Weakest and strongest force of each finger, N."""
    tolerance: Annotated[Positive, Field(le=0.1)] = 0.02
    """Distance from the goal within which the object's centre counts as placed, m."""
    release: bool = False
    """The object must also be let go. The paper's reward curves end in touch, so by default an
    episode ends with the placed object still held."""


@checked_dataclass
class PickPlaceReset:
    """Options of `PickPlace.reset`, each in place of a random draw."""

    object: ObjectName | None = None
    """Name of the catalogue (`touchgoal list objects`)."""
    mass: Mass | None = None
    """Of the object, kg."""
    grasp_force: Force | None = None
    """Of each finger, N."""


@checked_dataclass
class BeadMazeConfig(EnvConfig):
    """Options of bead-maze; reset's `options` override the random draws."""

    # Only a gel with markers shows the shear, by which the wire's sideways force is felt.
    sensor: str = "gelsight_mini_markers"
    """Sensor on both fingertips: a name (`touchgoal list sensors`), or the folder of a sensor file
    that `touchgoal calibrate` wrote. Only a gel with printed dots shows sideways force well."""
    cameras: tuple[Camera, ...] = ()
    """Cameras that are observed; fewer is faster."""
    max_seconds: Positive = 40.0
    """Length after which an episode ends, s."""
    wires: tuple[WireName, ...] = ()
    """Wires to draw from, by name, such as helix-1; default: the first `n-wires` of `split`."""
    split: Split = "training"
    """Set from which wires are taken; no wire is in two of them."""
    families: tuple[Family, ...] = TRAINED
    """Shapes of wires to take."""
    n_wires: Count | None = None
    """Number of wires to draw from; default: 200, or all where the split has fewer."""
    bead: Literal["sphere", "cylinder"] = "sphere"
    """Shape of the bead: a cylinder feels the wire's direction as a torque, a sphere much less."""
    grasp_force: ForceRange = (8.0, 12.0)
    """Weakest and strongest force of each finger, N."""
    start_angle: Annotated[NotNegative, Field(le=45)] = 0.0
    """Largest angle between the hand and the wire's first direction at the start, degrees."""
    wire_friction: Annotated[tuple[Friction, Friction], ORDERED] = (0.15, 0.25)
    """Least and greatest friction coefficient between bead and wire."""
    stall_seconds: Positive = 5.0
    """Time without 2 mm of progress after which the bead counts as jammed, s."""
    max_force: Positive = 30.0
    """External force on the hand that counts as too much, N."""

    def chosen_wires(self, count: int | None = None) -> list[Wire]:
        """The wires to draw from; if a count is given, so many of them, named ones in turn."""
        if not self.wires:
            most = min(200, PER_FAMILY[self.split] * len(self.families))
            return choose(self.split, count or self.n_wires or most, self.families)
        named = [find_wire(name) for name in self.wires]
        return named if count is None else [named[i % len(named)] for i in range(count)]


@checked_dataclass
class BeadMazeReset:
    """Options of `BeadMaze.reset`, each in place of a random draw."""

    wire: WireName | None = None
    """Name such as helix-1."""
    grasp_force: Force | None = None
    """Of each finger, N."""


def _is_multiple(value: float, of: float) -> bool:
    return value / of >= 0.999 and abs(value / of - round(value / of)) < 1e-6


TaskConfig = PickPlaceConfig | BeadMazeConfig
TASKS: dict[TaskName, type[PickPlaceConfig] | type[BeadMazeConfig]] = {
    "pick-place": PickPlaceConfig,
    "bead-maze": BeadMazeConfig,
}


@checked_dataclass
class TeleoperatorConfig:
    """How the hand follows the keys, and gives way to what it meets."""

    speed: Positive = 0.025
    """Speed at which a key moves the free hand, m/s."""
    turn_speed: Positive = 0.5
    """Speed at which a key turns the free hand, rad/s."""
    compliance: NotNegative = 2e-3
    """Speed by which the hand gives way to a force, m/s per N."""
    rotational_compliance: NotNegative = 2.0
    """Speed by which the hand gives way to a torque, rad/s per N m."""
    hold_seconds: Positive = 0.5
    """How long a typed key counts as held, s. A terminal does not report that a key was released; it
    repeats a held one after about 0.4 s, and only the last of several."""


@checked_dataclass
class RigConfig:
    """What is pressed into what."""

    sensor: str = "gelsight_mini_markers"
    """Fingertip sensor, by name or folder of a sensor file."""
    indenters: tuple[Indenter, ...] = ("sphere", "sharp", "flat")
    """Probes, which strokes take in turn."""
    load: Annotated[PositiveRange, RARE] = (0.5, 5.0)
    """Least and most normal load, N."""
    shear_relief: bool = True
    """The gel piles up in front of what is drawn over it and sinks behind, the one trace of shear in pictures without
    printed dots. Shipped encoders were trained on pictures without it."""
    seed: Seed = 0
    """Random seed of the sensor's unit and of all strokes."""
