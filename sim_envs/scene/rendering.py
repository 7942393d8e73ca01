"""Off-screen OpenGL, or one clear message about what it lacks."""

import os

import mujoco
import numpy as np

from touchgoal.runtime.errors import UserError

OPENGL_PACKAGES = "libegl1 libgl1"  # Debian and Ubuntu

_opened_in: int | None = None  # the process that first rendered; its forked children inherit this


class Renderer(mujoco.Renderer):
    """MuJoCo's renderer for one process: Mesa's threads and their locks survive no fork."""

    def __init__(self, model: mujoco.MjModel, height: int, width: int) -> None:
        check_process_may_render()
        self._process = os.getpid()
        super().__init__(model, height, width)

    def render(self, *, out: np.ndarray | None = None) -> np.ndarray:
        """Render the scene, RGB."""
        check_process_may_render()
        return super().render(out=out)

    def close(self) -> None:
        """Free the OpenGL context; a forked child leaves it to its parent."""
        if getattr(self, "_process", None) == os.getpid():
            super().close()


def open_renderer(model: mujoco.MjModel, rows: int, columns: int) -> Renderer:
    """Open a renderer with its own OpenGL context; close it after use.

    UserError: there are no OpenGL libraries, MuJoCo chose a platform that does not work, or the
    process was forked from one that has rendered.
    """
    global _opened_in
    if os.environ.get("MUJOCO_GL", "").lower() in ("disable", "disabled", "off", "false", "0"):
        raise UserError(
            "pictures need OpenGL, which this machine lacks; run: "
            f"sudo apt-get install {OPENGL_PACKAGES}"
        )
    try:
        renderer = Renderer(model, rows, columns)
    except mujoco.FatalError as error:
        raise UserError(
            f"OpenGL does not start ({error}); set MUJOCO_GL=egl, or import touchgoal before mujoco"
        ) from error
    _opened_in = os.getpid()
    return renderer


def check_process_may_render() -> None:
    """Raise UserError in a process forked after its parent had rendered: it would wait for ever."""
    if _opened_in not in (None, os.getpid()):
        raise UserError(
            "this process was forked after its parent had rendered, and OpenGL does not survive a "
            'fork: start the workers with context="forkserver" (gymnasium: AsyncVectorEnv('
            'env_fns, context="forkserver"))'
        )
