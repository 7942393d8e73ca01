"""Visual meshes with fewer triangles: corners that lie close together become one."""

import mujoco
import numpy as np
from jaxtyping import Float, Int

_FEWEST = 100  # triangles; a mesh that would have fewer stays as it is


def merge_corners(spec: mujoco.MjSpec, names: set[str], size: float) -> None:
    """Merge the corners of named meshes that lie in one cube of `size` m (Rossignac, Borrel 1993).

    In software OpenGL, most of an image's time goes to triangles smaller than a pixel.
    """
    model = spec.copy().compile()
    for mesh in [m for m in spec.meshes if m.name in names]:
        vertices, faces = _merged(*_read(model, model.mesh(mesh.name).id), size)
        if len(faces) >= _FEWEST:
            mesh.file = ""
            mesh.uservert, mesh.userface = vertices.ravel(), faces.ravel()
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX  # it need not be closed


def _read(
    model: mujoco.MjModel, mesh: int
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    """Return a mesh as its file has it, m: compiled, it lies about its centre of mass."""
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    vertices = model.mesh_vert[first : first + count].astype(float)
    first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    R = np.empty(9)
    mujoco.mju_quat2Mat(R, model.mesh_quat[mesh])
    faces = model.mesh_face[first : first + count]
    return vertices @ R.reshape(3, 3).T + model.mesh_pos[mesh], faces


def _merged(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], size: float
) -> tuple[Float[np.ndarray, "k 3"], Int[np.ndarray, "l 3"]]:
    cubes, cube = np.unique(np.floor(vertices / size), axis=0, return_inverse=True)
    means = np.zeros_like(cubes)
    np.add.at(means, cube.ravel(), vertices)
    means /= np.bincount(cube.ravel())[:, None]
    corners = cube.ravel()[faces]
    ordered = np.sort(corners, axis=1)
    _, first = np.unique(ordered, axis=0, return_index=True)
    kept = first[(np.diff(ordered[first], axis=1) > 0).all(1)]  # neither twice nor without an area
    used, corner = np.unique(corners[kept], return_inverse=True)
    return means[used], corner.reshape(-1, 3).astype(np.int32)
