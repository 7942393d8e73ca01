"""What presses into a gel: height fields of primitives by analytic rays, textures, force balance.

Sensor frame: x along image columns, y along rows, z out of the gel, origin on the undeformed
surface in the middle of the image; metres. A height field says how far above the undeformed
surface plane, into the gel, the object's near side lies: positive where it penetrates.
"""

import math
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Float32
from numba import njit

NO_SURFACE = np.float32(-0.95)  # m: a ray that meets nothing
HeightField = Float32[np.ndarray, "h w"]

BOX, CYLINDER, SPHERE, CAPSULE = 0, 1, 2, 3


@dataclass(frozen=True)
class Grid:
    """Rays of a height field: a rows x columns raster of `pitch` m centred on the sensor frame."""

    rows: int
    columns: int
    pitch: float


# The kernels below are branchless so that the compiler vectorises them over a row: a missed ray gets
# distance _FAR instead of leaving the loop. Rays start at z = _START and run along +z; in the
# object's frame their direction is constant, d, and their origins move linearly over the image.
_FAR = np.float32(1.0)
_START = np.float32(-0.05)
_TINY = np.float32(1e-9)


@njit(inline="always", fastmath=True)
@no_type_check
def _sphere(ox, oy, oz, d, radius):
    b = ox * d[0] + oy * d[1] + oz * d[2]
    disc = b * b - (ox * ox + oy * oy + oz * oz - radius * radius)
    t = -b - math.sqrt(max(disc, np.float32(0.0)))
    return t if disc >= 0 else _FAR


@njit(inline="always", fastmath=True)
@no_type_check
def _slab(o, inverse, half):
    t0, t1 = (-half - o) * inverse, (half - o) * inverse
    return min(t0, t1), max(t0, t1)


@njit(inline="always", fastmath=True)
@no_type_check
def _box(ox, oy, oz, inverse, size):
    x0, x1 = _slab(ox, inverse[0], size[0])
    y0, y1 = _slab(oy, inverse[1], size[1])
    z0, z1 = _slab(oz, inverse[2], size[2])
    near, far = max(x0, max(y0, z0)), min(x1, min(y1, z1))
    return near if near <= far else _FAR


@njit(inline="always", fastmath=True)
@no_type_check
def _side(ox, oy, oz, d, across, radius, half):
    """The curved side of a cylinder along z; `across` is 1 / (dx^2 + dy^2)."""
    b = ox * d[0] + oy * d[1]
    disc = b * b * across - (ox * ox + oy * oy - radius * radius)
    t = -b * across - math.sqrt(max(disc, np.float32(0.0)) * across)
    reach = abs(oz + t * d[2])
    return max(t if disc >= 0 else _FAR, t if reach <= half else _FAR)


@njit(inline="always", fastmath=True)
@no_type_check
def _cap(ox, oy, oz, d, inverse_z, radius, end):
    t = (end - oz) * inverse_z
    x, y = ox + t * d[0], oy + t * d[1]
    return t if x * x + y * y <= radius * radius else _FAR


@njit(inline="always", fastmath=True)
@no_type_check
def _cylinder(ox, oy, oz, d, across, inverse_z, size):
    half = size[1]
    ends = min(
        _cap(ox, oy, oz, d, inverse_z, size[0], half),
        _cap(ox, oy, oz, d, inverse_z, size[0], -half),
    )
    return min(_side(ox, oy, oz, d, across, size[0], half), ends)


@njit(inline="always", fastmath=True)
@no_type_check
def _capsule(ox, oy, oz, d, across, size):
    half = size[1]
    ends = min(_sphere(ox, oy, oz - half, d, size[0]), _sphere(ox, oy, oz + half, d, size[0]))
    return min(_side(ox, oy, oz, d, across, size[0], half), ends)


@njit(cache=True, fastmath=True)
@no_type_check
def _cast(out, pitch, kind, position, rotation, size):
    rows, columns = out.shape
    d = rotation[2]  # the sensor's z axis in the object's frame
    tiny = _TINY
    inverse = np.empty(3, np.float32)
    for k in range(3):
        inverse[k] = np.float32(1.0) / (d[k] if abs(d[k]) > tiny else tiny)
    across = np.float32(1.0) / max(d[0] * d[0] + d[1] * d[1], tiny)
    z = _START - position[2]
    y0, x0 = np.float32(0.5 * (rows - 1)), np.float32(0.5 * (columns - 1))
    ex, ey, ez = rotation[0, 0] * pitch, rotation[0, 1] * pitch, rotation[0, 2] * pitch
    for i in range(rows):
        y = (np.float32(i) - y0) * pitch - position[1]
        x = -x0 * pitch - position[0]
        ax = rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0] * z
        ay = rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1] * z
        az = rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2] * z
        row = out[i]
        if kind == SPHERE:
            for j in range(columns):
                n = np.float32(j)
                row[j] = -_START - _sphere(ax + n * ex, ay + n * ey, az + n * ez, d, size[0])
        elif kind == BOX:
            for j in range(columns):
                n = np.float32(j)
                row[j] = -_START - _box(ax + n * ex, ay + n * ey, az + n * ez, inverse, size)
        elif kind == CYLINDER:
            for j in range(columns):
                n = np.float32(j)
                t = _cylinder(ax + n * ex, ay + n * ey, az + n * ez, d, across, inverse[2], size)
                row[j] = -_START - t
        else:
            for j in range(columns):
                n = np.float32(j)
                t = _capsule(ax + n * ex, ay + n * ey, az + n * ez, d, across, size)
                row[j] = -_START - t


def primitive_height(
    grid: Grid,
    kind: int,
    position: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
    size: Float[np.ndarray, "3"],
) -> HeightField:
    """Height field of one primitive, given its pose in the sensor frame and MuJoCo size.

    float32: at fingertip distances its rounding is 4 nm.
    """
    out = np.empty((grid.rows, grid.columns), np.float32)
    pose = [np.asarray(a, np.float32) for a in (position, rotation, size)]
    _cast(out, np.float32(grid.pitch), kind, *pose)
    return out


@njit(cache=True, fastmath=True)
@no_type_check
def _pattern(texture, x, y, z, k, noise):
    """Height of a solid texture at a point of the object's frame, in units of its amplitude.

    Solid (a function of 3-D position) so that it sticks to any shape without seams. `k` is
    2 pi / wavelength.
    """
    if texture == 1:  # ribs: planes across the object's x + y diagonal, so that every side has some
        return math.sin(k * 0.7071 * (x + y))
    if texture == 2:  # dots: bumps on a lattice
        return math.sin(k * x) * math.sin(k * y) + math.sin(k * y) * math.sin(k * z)
    if texture == 4:  # weave: two crossed sets of threads, alternately above each other
        over = math.sin(0.5 * k * x + 0.5 * k * y) * math.sin(0.5 * k * z)
        along, across = math.sin(k * z), math.sin(k * 0.7071 * (x + y))
        return 0.6 * (along if over > 0.0 else across) + 0.4 * abs(over)
    n = noise.shape[0]
    scale = k / (2.0 * math.pi) * 2.0  # rough: trilinear noise, two cells a wavelength
    fx, fy, fz = x * scale, y * scale, z * scale
    ix, iy, iz = math.floor(fx), math.floor(fy), math.floor(fz)
    fx, fy, fz = fx - ix, fy - iy, fz - iz
    value = 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                weight = (fx if a else 1 - fx) * (fy if b else 1 - fy) * (fz if c else 1 - fz)
                value += weight * noise[int(ix + a) % n, int(iy + b) % n, int(iz + c) % n]
    return value


_NOISE = np.random.default_rng(20260101).uniform(-1.6, 1.6, (32, 32, 32)).astype(np.float32)


@njit(cache=True, fastmath=True)
@no_type_check
def _add_texture(height, below, pitch, texture, amplitude, k, position, rotation, noise):
    rows, columns = height.shape
    for i in range(rows):
        for j in range(columns):
            if height[i, j] > below:
                px = (j - 0.5 * (columns - 1)) * pitch - position[0]
                py = (i - 0.5 * (rows - 1)) * pitch - position[1]
                pz = -height[i, j] - position[2]
                x = rotation[0, 0] * px + rotation[1, 0] * py + rotation[2, 0] * pz
                y = rotation[0, 1] * px + rotation[1, 1] * py + rotation[2, 1] * pz
                z = rotation[0, 2] * px + rotation[1, 2] * py + rotation[2, 2] * pz
                height[i, j] += amplitude * _pattern(texture, x, y, z, k, noise)


def add_texture(
    height: HeightField,
    pitch: float,
    below: float,
    texture: int,
    amplitude: float,
    wavelength: float,
    position: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
) -> None:
    """Add a surface pattern in place, where the surface lies higher than `below` m."""
    if texture and amplitude > 0:
        k = 2 * math.pi / wavelength
        _add_texture(height, below, pitch, texture, amplitude, k, position, rotation, _NOISE)


@njit(cache=True, fastmath=True)
@no_type_check
def _volume(height, shift, cell):
    total = 0.0
    for i in range(height.shape[0]):
        for j in range(height.shape[1]):
            overlap = height[i, j] + shift
            if overlap > 0.0:
                total += overlap
    return total * cell


def settle(height: HeightField, pitch: float, force: float, modulus: float) -> float:
    """How far to push the object in (m) so that the gel's pressure sums to `force` N.

    The gel and the object's own give act as an elastic foundation: pressure = modulus x overlap.
    MuJoCo's penetration is no such measure: it depends on solver settings and the object's mass.
    """
    target, cell = force / modulus, pitch * pitch
    top = float(height.max())
    low, high = -top, -top + 0.02  # m; 20 mm of overlap is beyond any gripper's force
    for _ in range(40):
        middle = 0.5 * (low + high)
        if _volume(height, middle, cell) < target:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)
