"""Fine structure of surfaces: height patterns in micrometres on any shape."""

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Float32
from numba import njit

from touchgoal.sim_envs.scene.objects import Material, Texture
from touchgoal.sim_envs.tactile.rig.surfaces import WAVELENGTH, named_tile

# Wave vectors of the rough pattern, cycles per wavelength: directions from all around, lengths that
# share no period.
_ROUGH = (
    (0.41, 0.33, 0.77),
    (-0.83, 0.52, 0.21),
    (0.29, -1.07, 0.37),
    (0.61, 0.57, -0.93),
    (-0.67, -0.45, -1.21),
    (1.31, -0.23, -0.49),
)


@njit(inline="always", fastmath=True, error_model="numpy")
@no_type_check
def _wave(cycles):
    """Approximate sin(2 pi cycles) to 0.1 % by two parabolas, which the compiler vectorises."""
    t = cycles - np.floor(cycles + np.float32(0.5))
    y = np.float32(8.0) * t * (np.float32(1.0) - np.float32(2.0) * abs(t))
    return y * (np.float32(0.776) + np.float32(0.224) * abs(y))


@njit(inline="always", fastmath=True, error_model="numpy")
@no_type_check
def _ribs(x, y, z):
    """Planes across the x + y diagonal, so that every side of an object shows some."""
    return _wave(np.float32(0.7071) * (x + y))


@njit(inline="always", fastmath=True, error_model="numpy")
@no_type_check
def _dots(x, y, z):
    return _wave(y) * (_wave(x) + _wave(z))


@njit(inline="always", fastmath=True, error_model="numpy")
@no_type_check
def _rough(x, y, z):
    total = np.float32(0.0)
    for a, b, c in _ROUGH:
        total += _wave(np.float32(a) * x + np.float32(b) * y + np.float32(c) * z)
    return np.float32(0.5) * total


@njit(inline="always", fastmath=True, error_model="numpy")
@no_type_check
def _weave(x, y, z):
    """Two crossed sets of threads, alternately above each other."""
    half = np.float32(0.5)
    over = _wave(half * (x + y)) * _wave(half * z)
    thread = _wave(z) if over > 0 else _wave(np.float32(0.7071) * (x + y))
    return np.float32(0.6) * thread + np.float32(0.4) * abs(over)


@njit(cache=True, fastmath=True, error_model="numpy")
@no_type_check
def _add(height, below, pitch, texture, amplitude, frequency, position, rotation):
    rows, columns = height.shape
    scale = pitch * frequency
    ex, ey, ez = rotation[0, 0] * scale, rotation[0, 1] * scale, rotation[0, 2] * scale
    dx, dy, dz = rotation[2, 0] * frequency, rotation[2, 1] * frequency, rotation[2, 2] * frequency
    z0 = position[2]
    along = np.arange(columns).astype(np.float32)
    for i in range(rows):
        row = height[i]
        left, right = 0, columns
        while left < right and row[left] <= below:
            left += 1
        while left < right and row[right - 1] <= below:
            right -= 1
        py = (np.float32(i) - np.float32(0.5 * (rows - 1))) * pitch - position[1]
        px = np.float32(-0.5 * (columns - 1)) * pitch - position[0]
        ax = (rotation[0, 0] * px + rotation[1, 0] * py) * frequency
        ay = (rotation[0, 1] * px + rotation[1, 1] * py) * frequency
        az = (rotation[0, 2] * px + rotation[1, 2] * py) * frequency
        for j in range(left, right):
            n, depth = along[j], -(row[j] + z0)
            x = ax + n * ex + dx * depth
            y = ay + n * ey + dy * depth
            z = az + n * ez + dz * depth
            if texture == 1:
                pattern = _ribs(x, y, z)
            elif texture == 2:
                pattern = _dots(x, y, z)
            elif texture == 4:
                pattern = _weave(x, y, z)
            else:
                pattern = _rough(x, y, z)
            row[j] += amplitude * pattern if row[j] > below else np.float32(0.0)


@njit(cache=True, fastmath=True, error_model="numpy")
@no_type_check
def _add_tile(height, below, pitch, tile, amplitude, cells, position, rotation, facing):
    rows, columns = height.shape
    size = tile.shape[0]
    first, second = (facing + 1) % 3, (facing + 2) % 3
    for i in range(rows):
        y = (np.float32(i) - np.float32(0.5 * (rows - 1))) * pitch - position[1]
        row = height[i]
        for j in range(columns):
            if row[j] <= below:
                continue
            x = (np.float32(j) - np.float32(0.5 * (columns - 1))) * pitch - position[0]
            z = -row[j] - position[2]
            u = rotation[0, first] * x + rotation[1, first] * y + rotation[2, first] * z
            v = rotation[0, second] * x + rotation[1, second] * y + rotation[2, second] * z
            u, v = u * cells, v * cells
            iu, iv = int(np.floor(u)), int(np.floor(v))
            fu, fv = u - np.float32(iu), v - np.float32(iv)
            a, b, c, d = iu % size, (iu + 1) % size, iv % size, (iv + 1) % size
            near = tile[a, c] + fu * (tile[b, c] - tile[a, c])
            far = tile[a, d] + fu * (tile[b, d] - tile[a, d])
            row[j] += amplitude * (near + fv * (far - near))


def add_texture(
    height: Float32[np.ndarray, "h w"],
    pitch: float,
    material: Material,
    position: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
) -> None:
    """Add a material's pattern to a height field, in place, where it may touch the gel.

    The first patterns are functions of the point in the object's frame, so that they stick to any
    shape; the others are tiles, projected along the object's axis that faces the gel most.
    `position`, `rotation`: pose of the object in the sensor frame.
    """
    if not material.is_textured:
        return
    below, step = np.float32(-2 * material.amplitude), np.float32(pitch)
    amplitude, frequency = np.float32(material.amplitude), np.float32(1 / material.wavelength)
    place, turn = (np.asarray(a, np.float32) for a in (position, rotation))
    if material.texture > Texture.WOVEN:
        cells = np.float32(WAVELENGTH / material.wavelength)
        facing = int(np.abs(turn[2]).argmax())
        tile = named_tile(material.texture.name.lower())
        _add_tile(height, below, step, tile, amplitude, cells, place, turn, facing)
        return
    _add(height, below, step, int(material.texture), amplitude, frequency, place, turn)
