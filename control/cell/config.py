"""Sections and keys of a cell file: arm, gripper, sensors, task and limits of one cell.

`cell_file` puts each field's description and range into its messages.
"""

import re
from dataclasses import field
from ipaddress import ip_address
from typing import Annotated, Literal, cast, get_args

from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass

from touchgoal.control.sensors.load_cell import LoadCellConfig
from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import STRICT, Corners, Seed

Coordinate = Annotated[float, Field(ge=-3, le=3)]  # m, base frame
Corner = tuple[Coordinate, Coordinate, Coordinate]
HandCoordinate = Annotated[float, Field(ge=-0.5, le=0.5)]  # m, hand frame
HandPoint = tuple[HandCoordinate, HandCoordinate, HandCoordinate]
Angle = Annotated[float, Field(ge=-6.3, le=6.3)]  # rad
Rate = Annotated[float, Field(gt=0, le=1000)]  # Hz
Seconds = Annotated[float, Field(gt=0, le=5)]
Pixels = Annotated[int, Field(ge=16, le=8192)]
Exposure = Annotated[float, Field(gt=0, le=100_000)]
Width = Annotated[float, Field(ge=0, le=0.2)]  # m
Kelvin = Annotated[int, Field(ge=1000, le=15_000)]


def _landscape(size: tuple[int, int]) -> tuple[int, int]:
    if size[0] < size[1]:
        raise ValueError(f"must be width, then height: did you mean {[*size[::-1]]}?")
    return size


def _address(text: str) -> str:
    if re.fullmatch(r"[\d.]+", text):
        ip_address(text)  # raises ValueError
    return text


Size = Annotated[tuple[Pixels, Pixels], AfterValidator(_landscape)]
Address = Annotated[str, AfterValidator(_address)]  # numbers or a name
CameraName = Literal["front", "wrist"]
SimulatedTask = Literal["pick-place", "bead-maze"]
"""Tasks of the simulator that `deploy` and `twin` know."""
UnitComponent = Annotated[float, Field(ge=-1, le=1)]  # of a unit quaternion, wxyz
CameraPose = tuple[
    Coordinate, Coordinate, Coordinate, UnitComponent, UnitComponent, UnitComponent, UnitComponent
]
FieldOfView = Annotated[float, Field(gt=0, lt=180)]  # degrees


@dataclass(frozen=True, config=STRICT)
class GripperSection:
    """A gripper."""

    kind: Literal["franka_hand", "robotiq"]
    """franka_hand needs `address`, robotiq needs `port`."""
    address: Address = ""
    """Network address of a Franka Hand: the same as the arm's."""
    port: str = ""
    """Serial port of a Robotiq, such as /dev/ttyUSB0."""
    force: Annotated[float, Field(gt=0)] = 30.0
    """Force of its grasp, N."""
    widths: tuple[Width, Width] = (0.085, 0.0)
    """Width of a Robotiq open and closed, m: measure them with the fingertips mounted."""
    activate: bool = False
    """Whether a Robotiq may open and close fully once to become active."""


@dataclass(frozen=True, config=STRICT)
class ToolSection:
    """Everything the arm carries: gripper, mounts and fingertip sensors together.

    Hand frame: at the flange, z out of it, the fingers close along y.
    """

    tcp: Annotated[float, Field(gt=0, le=0.5)]
    """Distance from the flange to the middle between the two gels' centres, along the hand's z axis, m."""
    mass: Annotated[float, Field(gt=0, le=10)]
    """Mass beyond the flange, kg."""
    centre_of_mass: HandPoint
    """Centre of that mass, m (hand frame)."""
    finger_corners: Annotated[tuple[HandPoint, ...], Field(min_length=4)]
    """Corners of a box around the fingertips when the hand is open, m (hand frame)."""


@dataclass(frozen=True, config=STRICT)
class FingertipsSection:
    """The two fingertip sensors."""

    sensor: str
    """Model of both sensors, such as gelsight_mini."""
    left: str
    """USB serial number, or address of a stream."""
    right: str
    """USB serial number, or address of a stream."""
    rate: Rate | None = None
    """Images a second, Hz; default: the model's."""
    sensor_files: tuple[str, str] | None = None
    """Folders that calibrate wrote for the left and the right sensor; default: the model's for both."""
    size: Size | None = None
    """Width and height to ask the sensors' cameras for, pixels; default: their default."""
    border: Annotated[float, Field(ge=0, lt=0.5)] | None = None
    """Share cut off at each side of a camera's image; default: the model's."""
    corners: tuple[Corners, Corners] | None = None
    """Corners of the left and the right gel in the camera's image, px (top left, top right, bottom left,
    bottom right), for a camera at an angle (gelsight_wedge), in place of a border."""
    exposure: Exposure | None = None
    """Exposure to lock, in the camera's units (v4l2-ctl --list-ctrls); default: as it is set."""
    white_balance: Kelvin | None = None
    """White balance to lock, K; default: as it is set."""


@dataclass(frozen=True, config=STRICT)
class CameraSection:
    """A camera."""

    source: str
    """Device (/dev/video2), index, or address of a stream."""
    rate: Rate = 30.0
    """Images a second, Hz."""
    size: Size | None = None
    """Width and height to ask the camera for, pixels; default: its default."""
    exposure: Exposure | None = None
    """Exposure to lock, in the camera's units (v4l2-ctl --list-ctrls); default: as it is set."""
    white_balance: Kelvin | None = None
    """White balance to lock, K; default: as it is set."""
    pose: CameraPose | None = None
    """Place (x, y, z, m) and orientation (quaternion wxyz; z looks ahead, y down) as calibrate-camera writes
    it: of front in the base frame, of wrist in the hand frame. A simulated arm has its camera there."""
    fovy: FieldOfView | None = None
    """Vertical field of view, degrees, as calibrate-camera writes it; for a simulated arm, too."""


@dataclass(frozen=True, config=STRICT)
class TaskSection:
    """The task."""

    name: Annotated[str, Field(min_length=1, max_length=80)]
    """Name of the task: pick-place, bead-maze, or any other for a task of your own, which is known by its
    recordings alone: no object, no goal, and the episode ends by key or time."""
    policy: str = ""
    """Policy: expert (pick-place, from known positions), follower (bead-maze), shipped, a folder that
    train-policy made, a class of your own (file.py:Class), whose code then runs, or ws://host:port."""
    instruction: str = ""
    """Instruction in words, for the record; default: the name."""
    target: str | None = None
    """Object that a learned policy picks up where several lie on the table, in words."""
    seconds: Annotated[float, Field(gt=0, le=3600)] = 30.0
    """Time limit of the run, s."""
    start: tuple[Angle, ...] | None = None
    """Joint positions to begin from, rad; default: those of the arm."""
    grasp: tuple[Coordinate, Coordinate, Coordinate, Angle] | None = None
    """Expert's grasp: x, y, z (m, base frame) and yaw (rad) of the closing hand."""
    goal: tuple[Coordinate, Coordinate] | None = None
    """Expert's goal for the object on the table: x, y (m, base frame)."""
    twin: str = ""
    """Control port (token@host:port) of a twin, which resets its scene before each run and reports the
    places of objects and the success."""
    seed: Seed = seeds.EVALUATION.start
    """Random seed of the scene of a simulated arm or a twin."""
    objects: tuple[str, ...] = ()
    """pick-place on a simulated arm: names of objects to draw from; none: all."""
    wires: tuple[str, ...] = ()
    """bead-maze on a simulated arm: names of wires to draw from; none: all."""
    scene: SimulatedTask = "pick-place"
    """Scene of a simulated arm or a twin for a task of your own: that of pick-place or bead-maze."""
    rewards: tuple[str, ...] = ()
    """Goals whose distance is shown and recorded during the run, as those of reward-curves:
    episode:FOLDER#K, image:PATH, text:SENTENCE, force:N."""
    encoder: str = ""
    """Touch encoder for that distance, by name or folder; sentences need one aligned with texts. Default:
    the one that ships for the fingertips."""
    normalizer: str = ""
    """Normaliser of that distance: a normalizer.json that fit-normalizer made from successes in this cell.
    Default: the encoder's own on a simulated arm or a twin, the raw distance elsewhere."""
    judge: str = ""
    """Folder of fit-normalizer --judge, or gelsight_mini for the one that ships, in place of `rewards` and
    `normalizer`: its judge ends the run, and says at its end whether the task is done, in place of a
    simulator."""

    @property
    def own(self) -> bool:
        """Whether the task is known by its recordings alone."""
        return self.name not in get_args(SimulatedTask)

    @property
    def simulated(self) -> SimulatedTask:
        """Task whose scene a simulated arm stands in."""
        return self.scene if self.own else cast(SimulatedTask, self.name)


@dataclass(frozen=True, config=STRICT)
class SafetySection:
    """Limits for this cell; defaults are in `control.safety.limits`."""

    flange_lower: Corner | None = None
    """Lower corner of the box that the flange stays in, m (base frame)."""
    flange_upper: Corner | None = None
    """Upper corner of the box that the flange stays in, m (base frame)."""
    fingertips_lower: Corner | None = None
    """Lower corner of the box that the fingertips stay in, m (base frame)."""
    fingertips_upper: Corner | None = None
    """Upper corner of the box that the fingertips stay in, m (base frame)."""
    tip_speed: Annotated[float, Field(gt=0, le=3)] | None = None
    """Speed that the fingertips may reach, m/s."""
    velocity_share: Annotated[float, Field(gt=0, le=1)] | None = None
    """Share of the maker's joint speed that a policy may use."""
    force: Annotated[float, Field(gt=0, le=100)] | None = None
    """External force at the hand, or change of the load cell's force, that stops the arm, N; default:
    the task's own, above its demonstrations and below the arm's reflex."""
    torque: Annotated[float, Field(gt=0, le=100)] | None = None
    """External torque in a joint that stops the arm, Nm; default: the task's own."""
    indentation: Annotated[float, Field(gt=0, le=0.005)] | None = None
    """Indentation of a gel at which the arm stops and the hand opens, m; default: the task's own, at
    most what the sensor file can read."""
    observation_age: Seconds = 0.1
    """Age of an image at which the arm holds, s; five times that stops it. If you raise it, a learned
    policy goes slower with observations older than 0.1 s."""
    state_age: Seconds = 0.05
    """Age of the arm's state at which the arm holds, s; five times that stops it."""
    state_timeout: Seconds | None = None
    """Time without news of the controller after which it counts as lost, s; default: the driver's."""


@dataclass(frozen=True, config=STRICT)
class CellConfig:
    """Everything `deploy` needs to know."""

    arm: Literal["fr3", "ur5e", "sim"]
    """Arm; sim is a simulated FR3."""
    gripper: GripperSection
    """The gripper."""
    task: TaskSection
    """The task."""
    tool: ToolSection | None = None
    """Gripper, mounts and fingertips together; a simulated arm has its own."""
    address: Address = ""
    """Network address of the arm's controller, such as 172.16.0.2."""
    fingertips: FingertipsSection | None = None
    """The two fingertip sensors."""
    cameras: dict[CameraName, CameraSection] = field(default_factory=dict)
    """Cameras by place, front or wrist."""
    load_cell: LoadCellConfig | None = None
    """A load cell under the table."""
    safety: SafetySection = field(default_factory=SafetySection)
    """Limits for this cell."""
    lock_step: bool = False
    """Whether the arm is an FR3's twin that waits for its client; the control loop then follows its clock."""

    @property
    def moves_nothing_real(self) -> bool:
        """Whether the arm is simulated: in this program, or by a twin at the arm's own address."""
        host = self.task.twin.rpartition("@")[2].rpartition(":")[0]
        return self.arm == "sim" or bool(host) and host == self.address

    @property
    def time_waits(self) -> bool:
        """Whether the arm's time stands still while this program works."""
        return self.arm == "sim" or self.lock_step

    @property
    def sensor(self) -> str:
        """Model of the fingertips."""
        return self.fingertips.sensor if self.fingertips else "gelsight_mini"
