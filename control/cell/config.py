"""A cell file: which arm, gripper, sensors, task and limits belong together; read strictly."""

import json
import tomllib
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from touchgoal.control import features as ft
from touchgoal.control.errors import UserError

_EXAMPLES = "see launch/cells/"


@dataclass(frozen=True)
class GripperSection:
    """A gripper.

    Attributes:
        kind: franka_hand needs `address`, robotiq needs `port`.
        force: N of its grasp.
        widths: m, open and closed, of a Robotiq; measure them with the fingertips mounted.
        activate: whether a Robotiq may open and close fully once to become active.
    """

    kind: Literal["franka_hand", "robotiq"]
    address: str = ""
    port: str = ""
    force: float = 30.0
    widths: tuple[float, float] = (0.085, 0.0)
    activate: bool = False


@dataclass(frozen=True)
class FingertipsSection:
    """The two fingertip sensors.

    Attributes:
        sensor: which model both are.
        left, right: USB serial number, or address of a stream.
        rate: Hz; none: the model's.
    """

    sensor: str
    left: str
    right: str
    rate: float | None = None


@dataclass(frozen=True)
class CameraSection:
    """A camera: device (`/dev/video2`), index or stream; its rate (Hz) and (width, height)."""

    source: str
    rate: float = 30.0
    size: tuple[int, int] | None = None


@dataclass(frozen=True)
class LoadCellSection:
    """A load cell: see `control.load_cell.LoadCellConfig`."""

    port: str
    newtons_per_count: float
    zero: float
    max_force: float = 200.0


@dataclass(frozen=True)
class TaskSection:
    """What is to be done.

    Attributes:
        name: of the task.
        policy: expert (pick-place, from known positions), follower (bead-maze), shipped, or a
            folder that train-policy made.
        instruction: in words; it is recorded.
        seconds: after which it ends.
        start: joint positions (rad) to begin from; none: from where the arm is.
        grasp: for the expert, where to close the hand: x, y, z (m, base frame) and yaw (rad).
        goal: for the expert, where on the table it is to go: x, y (m).
        twin: control port of a twin, which is asked for both, and for success.
        seed, object, wire: of a simulated arm's episode.
        rewards: goals of the cost that is shown and recorded live, as those of reward-curves:
            episode:ROOT#K, image:PATH, text:SENTENCE.
    """

    name: Literal["pick-place", "bead-maze"]
    policy: str
    instruction: str = ""
    seconds: float = 30.0
    start: tuple[float, ...] | None = None
    grasp: tuple[float, float, float, float] | None = None
    goal: tuple[float, float] | None = None
    twin: str = ""
    seed: int = 1_000_000
    object: str = ""
    wire: str = ""
    rewards: tuple[str, ...] = ()


@dataclass(frozen=True)
class SafetySection:
    """Tighter or looser than `control.limits`; what is not given stays as it is there.

    Attributes:
        flange_lower, flange_upper, fingertips_lower, fingertips_upper: corners of the boxes, m.
        velocity_share: of the maker's speed that a policy may use.
        force, torque, touch: ceilings: N, Nm and m that a fingertip's gel is pressed in.
        observation_age, state_age: s at which the arm holds; five times that stops it.
        silence: s without news of the controller after which it is lost; none: the driver's own.
    """

    flange_lower: tuple[float, float, float] | None = None
    flange_upper: tuple[float, float, float] | None = None
    fingertips_lower: tuple[float, float, float] | None = None
    fingertips_upper: tuple[float, float, float] | None = None
    velocity_share: float | None = None
    force: float | None = None
    torque: float | None = None
    touch: float | None = None
    observation_age: float = 0.1
    state_age: float = 0.05
    silence: float | None = None


@dataclass(frozen=True)
class CellConfig:
    """Everything `deploy` needs to know.

    Attributes:
        arm: "sim" is a simulated FR3 in place of what is named.
        lock_step: the arm is a twin that waits for its client, so the control loop goes by its clock.
    """

    arm: Literal["fr3", "ur5e", "sim"]
    gripper: GripperSection
    task: TaskSection
    address: str = ""
    fingertips: FingertipsSection | None = None
    cameras: dict[str, CameraSection] = field(default_factory=dict)
    load_cell: LoadCellSection | None = None
    safety: SafetySection = field(default_factory=SafetySection)
    lock_step: bool = False

    @property
    def sensor(self) -> str:
        """The fingertips' model."""
        return self.fingertips.sensor if self.fingertips else "gelsight_mini"


def read_cell_file(path: Path, policy: str = "") -> CellConfig:
    """Read a cell file (TOML), or the `cell.json` that a twin has written.

    Args:
        path: of the file.
        policy: in place of the file's, if given.

    Raises:
        UserError: no such file, bad syntax, an unknown key, or a value that is missing or wrong.
    """
    if not path.is_file():
        raise UserError(f"there is no cell file {path}: {_EXAMPLES}")
    try:
        text = path.read_text()
        table = _of_twin(json.loads(text)) if path.suffix == ".json" else tomllib.loads(text)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is no TOML: {error}") from error
    except (json.JSONDecodeError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path} is no cell.json of a twin: start one with touchgoal twin"
        ) from error
    try:
        cell = _read(CellConfig, table, "")
        if policy:
            cell = replace(cell, task=replace(cell.task, policy=policy))
        _check(cell)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    return cell


def _check(cell: CellConfig) -> None:
    """What a type does not say."""
    gripper, task = cell.gripper, cell.task
    if cell.arm != "sim" and not cell.address:
        raise UserError("address is missing: give the arm's, such as 172.16.0.2")
    needed = {"franka_hand": "address", "robotiq": "port"}[gripper.kind]
    if cell.arm != "sim" and not getattr(gripper, needed):
        raise UserError(f"gripper.{needed} is missing: a {gripper.kind} needs it")
    known = [key.removeprefix(ft.IMAGE_PREFIX) for key in ft.CAMERAS]
    if unknown := cell.cameras.keys() - set(known):
        raise UserError(f"cameras.{min(unknown)} is unknown: there are {', '.join(known)}")
    if task.policy == "expert" and task.name == "bead-maze":
        raise UserError(
            "task.policy: the maze's expert lives in the simulator; follower or shipped"
        )
    if task.policy == "follower" and task.name != "bead-maze":
        raise UserError("task.policy: the follower is for the bead-maze; expert or a folder")
    knows = task.twin or (task.grasp and task.goal)
    if task.policy == "expert" and cell.arm != "sim" and not knows:
        raise UserError("task.grasp and task.goal are missing: measure where they are, in metres")


def _of_twin(cell: dict[str, Any]) -> dict[str, Any]:
    """A twin's description of itself as a cell.

    In lock-step time goes as slowly as the machine needs: by the clock on the wall, which drivers go
    by, pictures may be rare and the link silent for longer.
    """
    images = {key.removeprefix(ft.IMAGE_PREFIX): url for key, url in cell["images"].items()}
    sides = {key.removeprefix("tactile_"): images.pop(key) for key in list(images) if "tac" in key}
    pick_place = cell["task"] == "pick-place"
    slow = {"rate": 1.0} if cell["lock_step"] else {}
    table = {
        "arm": cell["arm"],
        "address": cell["address"],
        "gripper": cell["gripper"],
        "cameras": {name: {"source": url, **slow} for name, url in images.items()},
        "load_cell": cell["load_cell"],
        "lock_step": cell["lock_step"],
        "task": {
            "name": cell["task"],
            "policy": "expert" if pick_place else "shipped",
            "instruction": cell["instruction"],
            "twin": cell["faults"],
            "seconds": 40.0,
            "seed": cell["seed"],
            **cell["options"],
        },
    }
    table["safety"] = {"silence": 2.0} if cell["lock_step"] else {}
    if not pick_place:
        table["safety"]["force"] = 25.0  # a wire pushes back; the controller's reflex is at 30
    if sides:
        table["fingertips"] = {"sensor": cell["sensor"], **sides, **slow}
    return table


def _read(kind: Any, value: Any, where: str) -> Any:
    """A TOML value as `kind`; UserError, with the key, if it is none."""
    origin, arguments = get_origin(kind), get_args(kind)
    if is_dataclass(kind):
        return _read_table(kind, value, where)
    if origin in (Union, UnionType):
        return _read(next(a for a in arguments if a is not type(None)), value, where)
    if origin is dict:
        _require(isinstance(value, dict), where, "a table", value)
        return {name: _read(arguments[1], v, f"{where}.{name}") for name, v in value.items()}
    if origin is tuple:
        _require(isinstance(value, list), where, "a list", value)
        if arguments[-1] is ...:
            return tuple(_read(arguments[0], item, where) for item in value)
        _require(len(value) == len(arguments), where, f"a list of {len(arguments)}", value)
        return tuple(_read(a, item, where) for a, item in zip(arguments, value, strict=True))
    if origin is Literal:
        _require(value in arguments, where, " or ".join(arguments), value)
        return value
    wanted = (int, float) if kind is float else kind
    right = isinstance(value, wanted) and (kind is bool or not isinstance(value, bool))
    _require(right, where, {str: "text", bool: "true or false"}.get(kind, "a number"), value)
    return kind(value)


def _read_table(kind: Any, table: Any, where: str) -> Any:
    _require(isinstance(table, dict), where or "the file", "a table", table)
    dot = f"{where}." if where else ""
    known = {f.name: f for f in fields(kind)}
    if unknown := [name for name in table if name not in known]:
        raise UserError(f"{dot}{unknown[0]} is unknown: there are {', '.join(known)}")
    for name, f in known.items():
        needed = f.default is MISSING and f.default_factory is MISSING
        if needed and name not in table:
            raise UserError(f"{dot}{name} is missing: {_EXAMPLES}")
    hints = get_type_hints(kind)
    return kind(**{n: _read(hints[n], value, f"{dot}{n}") for n, value in table.items()})


def _require(right: bool, where: str, wanted: str, value: Any) -> None:
    if not right:
        raise UserError(f"{where} is to be {wanted}, not {value!r}")
