"""Height fields of objects over a gel: primitives by analytic rays, meshes by scan lines.

Sensor frame: x along image columns, y along rows, z out of the gel, origin on the undeformed
surface in the middle of the image; metres. Height: of an object's near side above that surface,
into the gel.
"""

import math
from dataclasses import dataclass
from typing import no_type_check

import mujoco
import numpy as np
from jaxtyping import Float, Float32, Int32
from numba import njit

NO_SURFACE = np.float32(-0.95)  # m: nothing there
HeightField = Float32[np.ndarray, "h w"]

BOX, CYLINDER = int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_CYLINDER)
SPHERE, CAPSULE = int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)


@dataclass(frozen=True)
class Grid:
    """Rays of a height field: a rows x columns raster of `pitch` m centred on the sensor frame."""

    rows: int
    columns: int
    pitch: float

    def empty(self) -> HeightField:
        """Return a height field without objects."""
        return np.full((self.rows, self.columns), NO_SURFACE)


# The kernels below are branchless so that the compiler vectorises them over a row: a missed ray
# gets the distance _FAR. In the object's frame all rays have the same direction d. A ray's origin o
# is its point nearest to the object's centre, which moves linearly over the image.
_FAR = np.float32(1.0)
_TINY = np.float32(1e-9)


@njit(inline="always", fastmath=True, error_model="numpy")
@no_type_check
def _sphere(ox, oy, oz, d, radius):
    b = ox * d[0] + oy * d[1] + oz * d[2]
    disc = b * b - (ox * ox + oy * oy + oz * oz - radius * radius)
    t = -b - math.sqrt(max(disc, np.float32(0.0)))
    return t if disc >= 0 else _FAR


@njit(inline="always", fastmath=True, error_model="numpy")
@no_type_check
def _slab(o, inverse, half):
    t0, t1 = (-half - o) * inverse, (half - o) * inverse
    return min(t0, t1), max(t0, t1)


@njit(inline="always", fastmath=True, error_model="numpy")
@no_type_check
def _box(ox, oy, oz, inverse, size):
    x0, x1 = _slab(ox, inverse[0], size[0])
    y0, y1 = _slab(oy, inverse[1], size[1])
    z0, z1 = _slab(oz, inverse[2], size[2])
    near, far = max(x0, max(y0, z0)), min(x1, min(y1, z1))
    return near if near <= far else _FAR


@njit(inline="always", fastmath=True, error_model="numpy")
@no_type_check
def _side(ox, oy, oz, d, across, radius, half):
    """Intersect the curved side of a cylinder along z; `across` is 1 / (dx^2 + dy^2)."""
    b = (ox * d[0] + oy * d[1]) * across
    disc = b * b - (ox * ox + oy * oy - radius * radius) * across
    t = -b - math.sqrt(max(disc, np.float32(0.0)))
    hit = (disc >= 0) & (abs(oz + t * d[2]) <= half)
    return t if hit else _FAR


@njit(inline="always", fastmath=True, error_model="numpy")
@no_type_check
def _cap(ox, oy, oz, d, inverse_z, radius, end):
    t = (end - oz) * inverse_z
    x, y = ox + t * d[0], oy + t * d[1]
    return t if x * x + y * y <= radius * radius else _FAR


@njit(inline="always", fastmath=True, error_model="numpy")
@no_type_check
def _cylinder(ox, oy, oz, d, across, inverse_z, size, near_end):
    cap = _cap(ox, oy, oz, d, inverse_z, size[0], near_end)
    return min(_side(ox, oy, oz, d, across, size[0], size[1]), cap)


@njit(inline="always", fastmath=True, error_model="numpy")
@no_type_check
def _capsule(ox, oy, oz, d, across, size):
    half = size[1]
    ends = min(_sphere(ox, oy, oz - half, d, size[0]), _sphere(ox, oy, oz + half, d, size[0]))
    return min(_side(ox, oy, oz, d, across, size[0], half), ends)


@njit(inline="always")
@no_type_check
def _inverse(value):
    return np.float32(1.0) / (value if abs(value) > _TINY else _TINY)


@njit(inline="always")
@no_type_check
def _span(centre, reach, cells):
    return max(int(centre - reach), 0), min(int(centre + reach) + 2, cells)


@njit(cache=True, fastmath=True, error_model="numpy")
@no_type_check
def _add_primitive(out, pitch, kind, position, rotation, size, bound):
    rows, columns = out.shape
    y0, x0 = np.float32(0.5 * (rows - 1)), np.float32(0.5 * (columns - 1))
    top, bottom = _span(y0 + position[1] / pitch, bound / pitch, rows)
    left, right = _span(x0 + position[0] / pitch, bound / pitch, columns)
    # The sensor's z axis in the object's frame. Tuples: an array might alias the output, which
    # would keep the loops from being vectorised.
    d = (rotation[2, 0], rotation[2, 1], rotation[2, 2])
    size = (size[0], size[1], size[2])
    inverse = (_inverse(d[0]), _inverse(d[1]), _inverse(d[2]))
    across = np.float32(1.0) / max(d[0] * d[0] + d[1] * d[1], _TINY)
    near_end = -size[1] if d[2] > 0 else size[1]
    z = position[2]
    # A table, because converting the loop's counter would prevent vectorisation.
    along = np.arange(columns).astype(np.float32)
    ex, ey, ez = rotation[0, 0] * pitch, rotation[0, 1] * pitch, rotation[0, 2] * pitch
    for i in range(top, bottom):
        y = (np.float32(i) - y0) * pitch - position[1]
        x = (np.float32(left) - x0) * pitch - position[0]
        ax = rotation[0, 0] * x + rotation[1, 0] * y
        ay = rotation[0, 1] * x + rotation[1, 1] * y
        az = rotation[0, 2] * x + rotation[1, 2] * y
        row = out[i, left:right]
        if kind == SPHERE:
            for j in range(right - left):
                n = along[j]
                t = _sphere(ax + n * ex, ay + n * ey, az + n * ez, d, size[0])
                row[j] = max(row[j], -z - t)
        elif kind == BOX:
            for j in range(right - left):
                n = along[j]
                t = _box(ax + n * ex, ay + n * ey, az + n * ez, inverse, size)
                row[j] = max(row[j], -z - t)
        elif kind == CYLINDER:
            for j in range(right - left):
                n = along[j]
                ox, oy, oz = ax + n * ex, ay + n * ey, az + n * ez
                t = _cylinder(ox, oy, oz, d, across, inverse[2], size, near_end)
                row[j] = max(row[j], -z - t)
        else:
            for j in range(right - left):
                n = along[j]
                t = _capsule(ax + n * ex, ay + n * ey, az + n * ez, d, across, size)
                row[j] = max(row[j], -z - t)


def _bounding_radius(kind: int, size: Float[np.ndarray, "3"]) -> float:
    if kind == SPHERE:
        return float(size[0])
    if kind == CAPSULE:
        return float(size[0] + size[1])
    return float(np.linalg.norm(size if kind == BOX else size[:2]))


def add_primitive(
    height: HeightField,
    pitch: float,
    kind: int,
    position: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
    size: Float[np.ndarray, "3"],
) -> None:
    """Raise a height field, in place, to the near side of one primitive (float32: 4 nm).

    Args:
        kind: BOX, CYLINDER, SPHERE or CAPSULE.
        position, rotation: pose of the primitive in the sensor frame.
        size: as MuJoCo takes it, m.
    """
    p, R, s = (np.asarray(a, np.float32) for a in (position, rotation, size))
    bound = np.float32(_bounding_radius(kind, size))
    _add_primitive(height, np.float32(pitch), kind, p, R, s, bound)


@njit(cache=True, fastmath=True, error_model="numpy")
@no_type_check
def _add_mesh(out, pitch, vertices, faces, position, rotation):
    rows, columns = out.shape
    zero, scale = np.float32(0.0), np.float32(1.0) / pitch
    y0, x0 = np.float32(0.5 * (rows - 1)), np.float32(0.5 * (columns - 1))
    px = np.empty(len(vertices), np.float32)
    py, height = np.empty_like(px), np.empty_like(px)
    for i in range(len(vertices)):
        vx, vy, vz = vertices[i]
        x = rotation[0, 0] * vx + rotation[0, 1] * vy + rotation[0, 2] * vz + position[0]
        y = rotation[1, 0] * vx + rotation[1, 1] * vy + rotation[1, 2] * vz + position[1]
        z = rotation[2, 0] * vx + rotation[2, 1] * vy + rotation[2, 2] * vz + position[2]
        px[i], py[i], height[i] = x * scale + x0, y * scale + y0, -z
    margin = np.float32(1e-3)  # px: neighbouring triangles overlap, which closes cracks
    for f in range(len(faces)):
        a, b, c = faces[f]
        abx, aby, acx, acy = px[b] - px[a], py[b] - py[a], px[c] - px[a], py[c] - py[a]
        area = acx * aby - abx * acy
        if area <= np.float32(1e-9):  # a back face, or edge-on
            continue
        top = max(int(math.ceil(min(py[a], py[b], py[c]) - margin)), 0)
        bottom = min(int(math.floor(max(py[a], py[b], py[c]) + margin)) + 1, rows)
        left = max(math.ceil(min(px[a], px[b], px[c]) - margin), zero)
        right = min(math.floor(max(px[a], px[b], px[c]) + margin), np.float32(columns - 1))
        if top >= bottom or left > right:
            continue
        highest = max(height[a], height[b], height[c])
        abh, ach = height[b] - height[a], height[c] - height[a]
        along = (ach * aby - abh * acy) / area
        down = (abh * acx - ach * abx) / area
        for i in range(top, bottom):
            first, last = left, right
            for u, v in ((a, b), (b, c), (c, a)):  # this row's stretch inside all three edges
                ex, ey = px[v] - px[u], py[v] - py[u]
                if abs(ey) > margin * margin:
                    x = px[u] + (np.float32(i) - py[u]) * ex / ey
                    if ey > zero:
                        first = max(first, x - margin)
                    else:
                        last = min(last, x + margin)
            start, stop = int(math.ceil(first)), int(math.floor(last))
            value = height[a] + down * (np.float32(i) - py[a]) - along * px[a]
            row = out[i]
            for j in range(start, stop + 1):
                row[j] = max(row[j], min(value + along * np.float32(j), highest))


def add_mesh(
    height: HeightField,
    pitch: float,
    vertices: Float32[np.ndarray, "n 3"],
    faces: Int32[np.ndarray, "m 3"],
    position: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
) -> None:
    """Raise a height field, in place, to the near side of a closed triangle mesh.

    Args:
        vertices: in the mesh's frame, m.
        faces: corners of the triangles, counter-clockwise from outside.
        position, rotation: pose of the mesh in the sensor frame.
    """
    pose = (np.asarray(a, np.float32) for a in (position, rotation))
    _add_mesh(height, np.float32(pitch), vertices, faces, *pose)
