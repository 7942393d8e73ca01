"""touchgoal: turn touch into a goal. See README.md."""

import os
import sys

__version__ = "0.1.0"

# MuJoCo picks its OpenGL platform when it is first imported. Without a screen only EGL works; a
# person who sets MUJOCO_GL keeps that.
if sys.platform == "linux" and "DISPLAY" not in os.environ:
    os.environ.setdefault("MUJOCO_GL", "egl")
