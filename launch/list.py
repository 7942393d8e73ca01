"""List objects, sensors, tasks, policies or encoders by name."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import tyro

import touchgoal
from touchgoal.policies.config import POLICIES
from touchgoal.runtime.option_types import checked_dataclass

_WEIGHTS = Path(touchgoal.__file__).parent / "encoders" / "weights"
Kind = Literal["objects", "sensors", "tasks", "policies", "encoders"]
TASKS = {
    "pick-place": "pick an object up and place it on a disc",
    "bead-maze": "lead a bead along a bent wire by touch",
    "fragile-carry": "carry a rod that slips when held too loosely and breaks when held too hard",
}
OWN_POLICIES = {
    "FOLDER": "a policy that train-policy made: its folder policy/",
    "MODULE:CLASS": "a class of your own with reset() and act(observation); or FILE.py:CLASS",
}


@checked_dataclass
class Config:
    """Options of list."""

    kind: Annotated[Kind | None, tyro.conf.Positional] = None
    """Kind to list; without it, the number of each."""


def main(config: Config) -> None:
    """Print a line for each."""
    if config.kind is None:
        for kind, (entries, use) in KINDS.items():
            print(f"{len(entries()):>4} {kind:<12}touchgoal list {kind:<12}used as: {use}")
        return
    entries = KINDS[config.kind][0]()
    width = max(len(name) for name in entries) + 2
    for name, meaning in entries.items():
        print(f"{name:<{width}}{meaning}")


def _objects() -> dict[str, str]:
    from touchgoal.sim_envs.scene.objects import CATALOGUE

    return {name: f"{kind.shape}: {kind.descriptions[0]}" for name, kind in CATALOGUE.items()}


def _sensors() -> dict[str, str]:
    from touchgoal.control.tactile.sensor_models import SENSORS

    found = {}
    for name, sensor in SENSORS.items():
        rows, columns = sensor.image_shape
        dots = "gel with printed dots" if sensor.markers else "plain gel"
        found[name] = f"{columns} x {rows} px, {1e3 * sensor.pixel_pitch:.3f} mm a pixel, {dots}"
    return found


def _encoders() -> dict[str, str]:
    found = {}
    for path in sorted(_WEIGHTS.glob("*/encoder.json")):
        made = json.loads(path.read_text())["config"]
        towers = f"towers {made['towers']}" if "towers" in made else "touch alone"
        found[path.parent.name] = f"for {made['sensor']}, {towers}"
    return found


KINDS: dict[Kind, tuple[Callable[[], dict[str, str]], str]] = {
    "objects": (_objects, "--env.objects NAME"),
    "sensors": (_sensors, "--env.sensor NAME"),
    "tasks": (lambda: TASKS, "--task NAME"),
    "policies": (lambda: POLICIES | OWN_POLICIES, "--policy NAME"),
    "encoders": (_encoders, "--encoder NAME"),
}
