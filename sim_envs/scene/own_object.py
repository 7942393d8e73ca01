"""An object of one's own from a mesh file, as its convex hull."""

import multiprocessing
import re
import sys
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from touchgoal.runtime.errors import UserError

_UNITS = {"metres": 1.0, "centimetres": 1e-2, "millimetres": 1e-3}
_METRE = 1.0  # a mesh larger than this is taken to be drawn in millimetres
_NARROWEST, _WIDEST = 0.008, 0.076  # m across the fingers; the hand opens to 0.08 m
_LARGEST = 0.25  # m
_HULL = "Qt TA96"  # Qhull's options: 100 vertices at most, 4 to begin with and 96 more
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
        vertices = _read_vertices(path, content)
        hull = vertices[ConvexHull(vertices, qhull_options=_HULL).vertices]
    except (ValueError, QhullError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"{path} is no solid mesh that can be read: {reason}") from error
    _, (width, depth), angle = cv2.minAreaRect(hull[:, :2].astype(np.float32))
    turn = np.deg2rad(angle if depth <= width else angle + 90)  # x along the longer side
    along, across = [np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0]
    hull = hull @ np.array([along, across, [0, 0, 1]]).T
    hull *= _metres_per_unit(path, np.ptp(hull, axis=0))
    return hull - (hull.max(0) + hull.min(0)) / 2


def _metres_per_unit(path: Path, extent: Float[np.ndarray, "3"]) -> float:
    """Return the assumed unit of a mesh, m, and say it; UserError if the hand cannot grasp the object."""
    assumed = "millimetres" if extent.max() > _METRE else "metres"
    unit, largest, across = _UNITS[assumed], extent.max(), extent[1]
    sizes = {
        name: " x ".join(f"{1e3 * own * s:.3g}" for s in extent) for name, own in _UNITS.items()
    }
    told = f"{path} is {sizes[assumed]} mm, read in {assumed}"
    others = [
        f"if it is drawn in {name}, it is {sizes[name]} mm: scale the mesh by {own / unit:g}"
        for name, own in _UNITS.items()
        if name != assumed and own * across >= _NARROWEST and own * largest <= _LARGEST
    ]
    if not (_NARROWEST <= unit * across <= _WIDEST and unit * largest <= _LARGEST):
        limits = "the hand grasps {:g} to {:g} mm across, {:g} mm at most along"
        limits = limits.format(1e3 * _NARROWEST, 1e3 * _WIDEST, 1e3 * _LARGEST)
        raise UserError(f"{told}; {limits}: {'; '.join(others) or 'scale the mesh'}")
    if multiprocessing.parent_process() is None:  # workers would repeat it
        print("; ".join([told, *others]), file=sys.stderr)
    return unit


def _read_vertices(path: Path, content: bytes) -> Float[np.ndarray, "n 3"]:
    """Return the vertices in a file's own unit; ValueError if it holds none."""
    is_obj = path.suffix.lower() == ".obj"
    size = int.from_bytes(content[80:84], "little")
    if not is_obj and len(content) == 84 + _TRIANGLE.itemsize * size:
        found = np.frombuffer(content, _TRIANGLE, offset=84)["corners"]
    else:
        key = rb"^\s*v" if is_obj else rb"\bvertex"
        found = np.array(re.findall(key + 3 * rb"\s+(\S+)", content, re.MULTILINE))
    vertices = np.unique(found.reshape(-1, 3).astype(np.float64), axis=0)
    if not vertices.size or not np.isfinite(vertices).all():
        raise ValueError("it holds no vertices, or some that are no numbers")
    return vertices
