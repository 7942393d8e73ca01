"""Gymnasium's ids of the environments: after `import touchgoal`, `gymnasium.make` knows them.

Light to import: neither Gymnasium nor MuJoCo is needed until one of the environments is made.
"""

import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any

# Id: the class, and how many control ticks an episode has at most (by the default options).
ENVIRONMENTS = {
    "touchgoal/PickPlace-v0": ("touchgoal.sim_envs.pick_place:PickPlace", 160),
    "touchgoal/BeadMaze-v0": ("touchgoal.sim_envs.bead_maze:BeadMaze", 800),
}


def register_environments() -> None:
    """Register the environments: now if Gymnasium is imported already, else as soon as it is.

    `import touchgoal` calls this, and stays light: to import Gymnasium takes longer than all else.
    """
    if "gymnasium" in sys.modules:
        _register()
    else:
        sys.meta_path.insert(0, _OnImportOfGymnasium())


def _register() -> None:
    from gymnasium.envs.registration import register, registry

    for name, (entry_point, ticks) in ENVIRONMENTS.items():
        if name not in registry:
            register(name, entry_point, max_episode_steps=ticks)


class _OnImportOfGymnasium(MetaPathFinder):
    """Finds Gymnasium where it is, once, and registers the environments when it is loaded."""

    def find_spec(
        self, fullname: str, path: Any, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = find_spec(fullname)
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def load_and_register(module: ModuleType) -> None:
                load(module)
                _register()

            spec.loader.exec_module = load_and_register
        return spec
