"""Off-screen OpenGL, or one clear message about what it lacks."""

import hashlib
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
        self._uploaded = _uploaded(model)
        super().__init__(model, height, width, max_geom=_most_geoms(model))

    def show(self, model: mujoco.MjModel) -> bool:
        """Render another model of the same options from now on; False if its meshes or textures differ.

        That takes no time, unlike a new OpenGL context.
        """
        if _uploaded(model) != self._uploaded:
            return False
        self._model = model
        self._scene = mujoco.MjvScene(model=model, maxgeom=_most_geoms(model))
        return True

    def render(self, *, out: np.ndarray | None = None) -> np.ndarray:
        """Render the scene, RGB."""
        check_process_may_render()
        return super().render(out=out)

    def close(self) -> None:
        """Free the OpenGL context; a forked child leaves it to its parent."""
        if getattr(self, "_process", None) == os.getpid():
            super().close()


def _most_geoms(model: mujoco.MjModel) -> int:
    """Return the room of a scene for all that can be drawn: MuJoCo's 10,000 take 10 ms to allocate."""
    return model.ngeom + 300


def _uploaded(model: mujoco.MjModel) -> str:
    """Return a hash of all that a renderer's context holds of a model."""
    digest = hashlib.sha256()
    for name in (
        "mesh_vert",
        "mesh_normal",
        "mesh_texcoord",
        "mesh_face",
        "mesh_graph",
        "tex_data",
    ):
        digest.update(getattr(model, name).tobytes())
    return digest.hexdigest()


def open_renderer(model: mujoco.MjModel, rows: int, columns: int) -> Renderer:
    """Open a renderer with its own OpenGL context; close it after use.

    UserError: there are no OpenGL libraries, MuJoCo chose a platform that does not work, or the
    process was forked from one that has rendered.
    """
    global _opened_in
    if os.environ.get("MUJOCO_GL", "").lower() in ("disable", "disabled", "off", "false", "0"):
        raise UserError(
            "images need OpenGL, which this machine lacks; run: "
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
