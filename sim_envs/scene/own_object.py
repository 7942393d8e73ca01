"""An object of one's own from a mesh file, as its convex hull."""

from pathlib import Path

import cv2
import mujoco
import numpy as np
from jaxtyping import Float

from touchgoal.runtime.errors import UserError

_METRE = 1.0  # an object larger than this is taken to be drawn in millimetres
_NARROWEST, _WIDEST = 0.008, 0.076  # m across the fingers; the hand opens to 0.08 m
_LARGEST = 0.25  # m
_MOST_VERTICES = 100  # of the hull
_SHELL = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
_CONVEX = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX


def read_hull(path: Path) -> Float[np.ndarray, "n 3"]:
    """Return the vertices of a mesh's convex hull, m, centred on its bounding box.

    z stays up; the narrowest side seen from above is turned along y, across which the hand closes.
    STL files must be binary. A mesh of more than a metre is read as millimetres. UserError: no such
    file, no mesh with a volume, or a size that the hand cannot grasp.
    """
    hull = _hull(_read_vertices(path))
    if np.ptp(hull, axis=0).max() > _METRE:
        hull = hull / 1000
    _, (width, depth), angle = cv2.minAreaRect(hull[:, :2].astype(np.float32))
    turn = np.deg2rad(angle if depth <= width else angle + 90)  # x along the longer side
    along, across = [np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0]
    hull = hull @ np.array([along, across, [0, 0, 1]]).T
    extent = np.ptp(hull, axis=0)
    sides = " x ".join(f"{1000 * side:.0f}" for side in extent)
    if not (_NARROWEST <= extent[1] <= _WIDEST and extent.max() <= _LARGEST):
        raise UserError(
            f"{path} is {sides} mm; the hand grasps {1000 * _NARROWEST:.0f} to "
            f"{1000 * _WIDEST:.0f} mm across, {1000 * _LARGEST:.0f} mm at most along: scale the mesh"
        )
    return hull - (hull.max(0) + hull.min(0)) / 2


def _read_vertices(path: Path) -> Float[np.ndarray, "n 3"]:
    if not path.is_file():
        raise UserError(f"there is no mesh {path}")
    spec = mujoco.MjSpec()
    try:
        spec.add_mesh(name="own", file=str(path.resolve()), inertia=_SHELL)
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="own")
        model = spec.compile()
    except ValueError as error:
        reason = str(error).splitlines()[0]
        raise UserError(
            f"{path} is no solid mesh that can be read (STL must be binary): {reason}"
        ) from error
    # MuJoCo moves a mesh to its centre of mass and principal axes
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.mesh_quat[0])
    return model.mesh_vert @ rotation.reshape(3, 3).T + model.mesh_pos[0]


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
