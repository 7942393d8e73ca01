"""An object of one's own from a mesh file, as its convex hull."""

import multiprocessing
import re
import sys
from pathlib import Path

import cv2
import mujoco
import numpy as np
from jaxtyping import Float

from touchgoal.runtime.errors import UserError

_UNITS = {"metres": 1.0, "centimetres": 1e-2, "millimetres": 1e-3}
_METRE = 1.0  # a mesh larger than this is taken to be drawn in millimetres
_NARROWEST, _WIDEST = 0.008, 0.076  # m across the fingers; the hand opens to 0.08 m
_LARGEST = 0.25  # m
_MOST_VERTICES = 100  # of the hull
_CONVEX = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_hull(path: Path, content: bytes) -> Float[np.ndarray, "n 3"]:
    """Return the vertices of a mesh's convex hull, m, centred on its bounding box; print its size.

    z stays up; the narrowest side seen from above is turned along y, across which the hand closes.
    A mesh of more than a metre is read as millimetres. UserError: no mesh with a volume, or a size
    that the hand cannot grasp.

    Args:
        path: Name of the file: STL (binary or text) or OBJ.
        content: What it holds.
    """
    try:
        hull = _hull(_read_vertices(path, content))
    except ValueError as error:
        raise UserError(
            f"{path} is no solid mesh that can be read: {str(error).splitlines()[0]}"
        ) from error
    _, (width, depth), angle = cv2.minAreaRect(hull[:, :2].astype(np.float32))
    turn = np.deg2rad(angle if depth <= width else angle + 90)  # x along the longer side
    along, across = [np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0]
    hull = hull @ np.array([along, across, [0, 0, 1]]).T
    hull *= _metres_per_unit(path, np.ptp(hull, axis=0))
    return hull - (hull.max(0) + hull.min(0)) / 2


def _metres_per_unit(path: Path, extent: Float[np.ndarray, "3"]) -> float:
    """Return the assumed unit of a mesh, m, and say it; UserError if the hand cannot grasp the object."""
    assumed = "millimetres" if extent.max() > _METRE else "metres"
    unit = _UNITS[assumed]
    sizes = {
        name: " x ".join(f"{1e3 * own * s:.3g}" for s in extent) for name, own in _UNITS.items()
    }
    size = f"{path} is {sizes[assumed]} mm"
    others = [
        f"if it is drawn in {name}, it is {sizes[name]} mm: scale the mesh by {own / unit:g}"
        for name, own in _UNITS.items()
        if name != assumed and own * extent[1] >= _NARROWEST and own * extent.max() <= _LARGEST
    ]
    if not (_NARROWEST <= unit * extent[1] <= _WIDEST and unit * extent.max() <= _LARGEST):
        raise UserError(
            f"{size}, read in {assumed}; the hand grasps {1000 * _NARROWEST:.0f} to "
            f"{1000 * _WIDEST:.0f} mm across, {1000 * _LARGEST:.0f} mm at most along: "
            + ("; ".join(others) or "scale the mesh")
        )
    if multiprocessing.parent_process() is None:  # workers would repeat it
        print("; ".join([f"{size}, read in {assumed}", *others]), file=sys.stderr)
    return unit


def _read_vertices(path: Path, content: bytes) -> Float[np.ndarray, "n 3"]:
    """Return the vertices in a file's own unit; ValueError if it holds none.

    Not by MuJoCo, which reads no text STL and keeps a file that is replaced within a second.
    """
    is_obj = path.suffix.lower() == ".obj"
    size = int.from_bytes(content[80:84], "little")
    if not is_obj and len(content) == 84 + _TRIANGLE.itemsize * size:
        vertices = np.frombuffer(content, _TRIANGLE, offset=84)["corners"].reshape(-1, 3)
    else:
        key = rb"^\s*v" if is_obj else rb"\bvertex"
        lines = re.findall(key + 3 * rb"\s+(\S+)", content, re.MULTILINE)
        vertices = np.array(lines).reshape(-1, 3)
    vertices = np.unique(vertices.astype(np.float64), axis=0)
    if not vertices.size or not np.isfinite(vertices).all():
        raise ValueError("it holds no vertices, or some that are no numbers")
    return vertices


def _hull(vertices: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "h 3"]:
    spec = mujoco.MjSpec()
    spec.add_mesh(
        name="own", uservert=vertices.ravel().tolist(), maxhullvert=_MOST_VERTICES, inertia=_CONVEX
    )
    body = spec.worldbody.add_body()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="own", density=1000)
    model = spec.compile()
    # mesh_graph: numbers of vertices and faces, an address for each vertex, then their indices
    count, graph = model.mesh_graph[0], model.mesh_graph
    corners = graph[2 + count : 2 + 2 * count]
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.mesh_quat[0])
    return model.mesh_vert[corners] @ rotation.reshape(3, 3).T + model.mesh_pos[0]
