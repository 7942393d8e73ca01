"""Off-screen OpenGL, or one clear line on what it lacks."""

import os

import mujoco

from touchgoal.control.errors import UserError

OPENGL_PACKAGES = "libegl1 libgl1"  # Debian and Ubuntu


def open_renderer(model: mujoco.MjModel, rows: int, columns: int) -> mujoco.Renderer:
    """A renderer of its own OpenGL context; close it.

    Raises:
        UserError: there are no OpenGL libraries, or MuJoCo chose a platform that does not work.
    """
    if os.environ.get("MUJOCO_GL", "").lower() in ("disable", "disabled", "off", "false", "0"):
        raise UserError(
            "pictures need OpenGL, which this machine lacks; run: "
            f"sudo apt-get install {OPENGL_PACKAGES}"
        )
    try:
        return mujoco.Renderer(model, rows, columns)
    except mujoco.FatalError as error:
        raise UserError(
            f"OpenGL does not start ({error}); set MUJOCO_GL=egl, or import touchgoal before mujoco"
        ) from error
