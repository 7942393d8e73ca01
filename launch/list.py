"""List what there is by name: objects, sensors, tasks, policies, encoders or benchmarks."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import tyro

import touchgoal
from touchgoal.runtime.option_types import checked_dataclass

_WEIGHTS = Path(touchgoal.__file__).parent / "encoders" / "weights"
Kind = Literal["objects", "sensors", "tasks", "policies", "encoders", "benchmarks"]


@checked_dataclass
class Config:
    """Options of list."""

    kind: Annotated[Kind | None, tyro.conf.Positional] = None
    """What to list; without it, how many there are of each."""


def main(config: Config) -> None:
    """Print a line for each."""
    if config.kind is None:
        for kind, entries in KINDS.items():
            print(f"{len(entries()):>4} {kind:<12}touchgoal list {kind}")
        return
    entries = KINDS[config.kind]()
    width = max(len(name) for name in entries) + 2
    for name, meaning in entries.items():
        print(f"{name:<{width}}{meaning}")


def objects() -> dict[str, str]:
    """The catalogue that pick-place draws from."""
    from touchgoal.sim_envs.scene.objects import CATALOGUE

    return {name: f"{kind.shape}: {kind.descriptions[0]}" for name, kind in CATALOGUE.items()}


def sensors() -> dict[str, str]:
    """Models of fingertip sensors."""
    from touchgoal.control.tactile.sensor_models import SENSORS

    def describe(name: str) -> str:
        sensor = SENSORS[name]
        (rows, columns), pitch = sensor.image_shape, 1e3 * sensor.pixel_pitch
        dots = "gel with printed dots" if sensor.markers else "plain gel"
        return f"{columns} x {rows} px, {pitch:.3f} mm a pixel, {dots}"

    return {name: describe(name) for name in SENSORS}


def tasks() -> dict[str, str]:
    """What `--task` takes."""
    return {
        "pick-place": "pick an object up and place it on a disc",
        "bead-maze": "lead a bead along a bent wire by feel",
    }


def policies() -> dict[str, str]:
    """What `--policy` takes."""
    return {
        "expert": "the task's expert, which sees the simulator's state",
        "follower": "bead-maze: the classical one, which feels the force on the hand",
        "shipped": "the learned policy that ships for the task",
        "FOLDER": "a policy that train-policy made: its folder policy/",
        "MODULE:CLASS": "a class of your own with reset() and act(observation); or FILE.py:CLASS",
    }


def encoders() -> dict[str, str]:
    """The touch encoders that ship."""
    found = {}
    for path in sorted(_WEIGHTS.glob("*/encoder.json")):
        made = json.loads(path.read_text())["config"]
        towers = f"towers {made['towers']}" if "towers" in made else "touch alone"
        found[path.parent.name] = f"for {made['sensor']}, {towers}"
    return found


def benchmarks() -> dict[str, str]:
    """What `touchgoal benchmark` takes."""
    from touchgoal.launch.benchmark import BENCHMARKS

    return {name: meaning for name, (_, meaning) in BENCHMARKS.items()}


KINDS: dict[Kind, Callable[[], dict[str, str]]] = {
    "objects": objects,
    "sensors": sensors,
    "tasks": tasks,
    "policies": policies,
    "encoders": encoders,
    "benchmarks": benchmarks,
}
