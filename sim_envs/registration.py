"""Gymnasium's ids of the environments, registered without importing Gymnasium.

Gymnasium has no entry points for plugins since 1.0: a package registers its ids when it is imported.
"""

import sys
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any

_ENVIRONMENTS = {  # class and control ticks of an episode, by id
    "touchgoal/PickPlace-v0": ("touchgoal.sim_envs.pick_place:PickPlace", 160),
    "touchgoal/BeadMaze-v0": ("touchgoal.sim_envs.bead_maze:BeadMaze", 800),
    "touchgoal/FragileCarry-v0": ("touchgoal.sim_envs.fragile_carry:FragileCarry", 160),
    "touchgoal/TouchWand-v0": ("touchgoal.sim_envs.touch_wand:TouchWand", 50),
}


def register_environments() -> None:
    """Register the ids now if Gymnasium is imported, else as soon as it is."""
    if (gymnasium := sys.modules.get("gymnasium")) is not None:
        _register(gymnasium)
    else:
        sys.meta_path.insert(0, _GymnasiumFinder())


def _register(gymnasium: ModuleType) -> None:
    for name, (environment, ticks) in _ENVIRONMENTS.items():
        gymnasium.register(name, environment, max_episode_steps=ticks)


class _GymnasiumFinder:
    """Finds Gymnasium where it is installed, once, and registers the ids after its import."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return the spec of Gymnasium; None for any other module."""
        if name != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = find_spec(name)
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def load_and_register(module: ModuleType) -> None:
                load(module)
                _register(module)

            spec.loader.exec_module = load_and_register
        return spec
