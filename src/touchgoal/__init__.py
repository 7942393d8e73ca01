"""touchgoal: turn touch into a goal. See README.md."""

import ctypes
import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

from touchgoal.runtime.version import __version__ as __version__
from touchgoal.sim_envs.registration import register_environments

if TYPE_CHECKING:
    from touchgoal.encoders.pretrained import load_encoder as load_encoder
    from touchgoal.episodes.format.joined import load_episodes as load_episodes
    from touchgoal.policies.checkpoint import load_policy as load_policy
    from touchgoal.policies.evaluation.evaluate import evaluate as evaluate
    from touchgoal.rewards.environments import make as make
    from touchgoal.rewards.environments import make_vec as make_vec
    from touchgoal.rewards.reward import Reward as Reward


def _headless_opengl() -> str:
    """Return MuJoCo's platform without a screen: EGL, or without its libraries no rendering."""
    try:
        ctypes.CDLL("libEGL.so.1")
        ctypes.CDLL("libGL.so.1")
    except OSError:
        return "disable"
    return "egl"


# MuJoCo reads this when it is first imported; a value that the user set stays.
if sys.platform == "linux" and "DISPLAY" not in os.environ and "MUJOCO_GL" not in os.environ:
    os.environ["MUJOCO_GL"] = _headless_opengl()

register_environments()

_INTERFACE = {  # one call a job, imported at its first use: `import touchgoal` stays light
    "Reward": "touchgoal.rewards.reward",
    "evaluate": "touchgoal.policies.evaluation.evaluate",
    "load_encoder": "touchgoal.encoders.pretrained",
    "load_policy": "touchgoal.policies.checkpoint",
    "load_episodes": "touchgoal.episodes.format.joined",
    "make": "touchgoal.rewards.environments",
    "make_vec": "touchgoal.rewards.environments",
}


def __getattr__(name: str) -> Any:
    if name in _INTERFACE:
        return getattr(import_module(_INTERFACE[name]), name)
    raise AttributeError(f"module 'touchgoal' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*_INTERFACE, "__doc__", "__version__"])
