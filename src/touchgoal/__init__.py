"""touchgoal: turn touch into a goal. See README.md."""

import ctypes
import os
import sys

__version__ = "0.1.0"


def _headless_opengl() -> str:
    """MuJoCo's platform without a screen: EGL, or none if its libraries are not installed.

    Without this choice `import mujoco` itself fails on such a machine; with it only what draws
    fails, and says which packages to install (`sim_envs/scene/rendering.py`).
    """
    try:
        ctypes.CDLL("libEGL.so.1")
        ctypes.CDLL("libGL.so.1")
    except OSError:
        return "disable"
    return "egl"


# MuJoCo reads this when it is first imported; a person who sets it keeps their choice.
if sys.platform == "linux" and "DISPLAY" not in os.environ and "MUJOCO_GL" not in os.environ:
    os.environ["MUJOCO_GL"] = _headless_opengl()

from touchgoal.sim_envs.registration import register_environments  # noqa: E402

register_environments()
