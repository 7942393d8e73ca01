"""Dots printed on a gel: rest positions, motion with the gel, drawing."""

from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from numba import njit

from touchgoal.control.tactile.sensor_models import MarkerGrid, SensorModel
from touchgoal.sim_envs.tactile.forces import ForceField
from touchgoal.sim_envs.tactile.geometry import Grid

DARKNESS = 0.7  # share of the light taken, a guess: print on a lit gel is not black
# Friction holds the gel under an object. Under a stuck ball the gel spreads by 10 % of the
# frictionless amount in the middle, 60 % at the rim and 80 % outside: the share falls with the
# local pressure. (From the layer solved for a growing contact, ball radius 5 to 25 mm, 1 to 15 N.)
_FREE = 0.8


def rest_positions(
    grid: MarkerGrid, shape: tuple[int, int], pitch: float
) -> Float32[np.ndarray, "n 2"]:
    """Return dots of a resting gel that lie fully inside the image: (x, y) in px, row by row.

    Args:
        shape: (rows, columns) of the image, whose pixel centres are at integers.
        pitch: m of gel per pixel.
    """
    size = np.array(shape[::-1])
    offset = _raster(grid.rows, grid.columns, grid.pitch / pitch)
    inside = (np.abs(offset) <= (size - grid.diameter / pitch) / 2).all(1)
    return ((size - 1) / 2 + offset[inside]).astype(np.float32)


def _raster(rows: int, columns: int, pitch: float) -> Float[np.ndarray, "n 2"]:
    y, x = np.mgrid[0:rows, 0:columns]
    return pitch * np.stack([x - (columns - 1) / 2, y - (rows - 1) / 2], -1).reshape(-1, 2)


def layer_compliance(
    sensor: SensorModel, k: Float[np.ndarray, "*shape"]
) -> tuple[Float[np.ndarray, "*shape"], Float[np.ndarray, "*shape"], Float[np.ndarray, "*shape"]]:
    """Return the surface compliance of a gel to loads that are waves of number k (1/m).

    The gel is an incompressible elastic layer bonded to a rigid base (plane and antiplane strain).
    Returns displacement per traction along the wave and across it, m/Pa, and minus the displacement
    per gradient of pressure, m^2/Pa: pressed down, the gel is squeezed aside.
    """
    t, shear = sensor.gel_thickness, sensor.shear_modulus
    k = np.maximum(k, 1e-3)
    # a deeper layer is as good as infinite, and cosh would overflow
    depth = np.minimum(k * t, 40.0)
    ground = np.cosh(2 * depth) + 1 + 2 * depth**2
    along = (np.sinh(2 * depth) + 2 * depth) / (2 * shear * k * ground)
    return along, np.tanh(depth) / (shear * k), t * t / (shear * ground)


def _responses(
    sensor: SensorModel, step: float, size: float, offset: Float[np.ndarray, "n m 2"]
) -> Float32[np.ndarray, "5 n m"]:
    """Return displacements (m) per N on a square of `size` m, averaged over one at an offset."""
    n = 1 << int(np.ceil(np.log2(2.2 * max(sensor.gel_size) / step)))
    k = 2 * np.pi * np.fft.fftfreq(n, step)
    kx, ky = k[None], k[:, None]
    wave = np.hypot(kx, ky)
    along, across, squeeze = layer_compliance(sensor, wave)
    cosine, sine = kx / np.maximum(wave, 1e-3), ky / np.maximum(wave, 1e-3)
    more = along - across
    square = (np.sinc(kx * size / (2 * np.pi)) * np.sinc(ky * size / (2 * np.pi)) / step) ** 2
    spectra = (
        across + more * cosine**2,
        more * cosine * sine,
        across + more * sine**2,
        -1j * kx * squeeze,
        -1j * ky * squeeze,
    )
    place = (offset / step + n // 2).astype(np.float32)
    tables = (np.fft.fftshift(np.fft.ifft2(s * square).real) for s in spectra)
    x, y = (np.ascontiguousarray(place[..., axis]) for axis in (0, 1))
    return np.stack([cv2.remap(t.astype(np.float32), x, y, cv2.INTER_LINEAR) for t in tables])


@njit(cache=True, fastmath=True)
@no_type_check
def _move(normal, tangential, responses, patch, stiffness, here, out):
    rows, columns = normal.shape
    zero = np.float32(0.0)
    wide = (columns + 3) // 4
    load = np.zeros(patch.shape[1], np.float32)
    highest = zero
    for i in range(rows):
        for j in range(columns):
            load[i // 4 * wide + j // 4] += normal[i, j]
            highest = max(highest, normal[i, j])
    total, give_x, give_y = load.sum(), zero, zero
    for a in range(load.size):
        if load[a] > zero:
            for b in range(load.size):
                give_x += load[a] * load[b] * patch[0, a, b]
                give_y += load[a] * load[b] * patch[1, a, b]
    scale_x, scale_y = total * total / (stiffness * give_x), total * total / (stiffness * give_y)
    squeezed = np.zeros_like(out)
    out[:] = zero
    for i in range(rows // 2):
        for j in range(columns // 2):
            p, x, y = zero, zero, zero
            for a in range(2 * i, 2 * i + 2):
                for b in range(2 * j, 2 * j + 2):
                    p += normal[a, b]
                    x += tangential[0, a, b]
                    y += tangential[1, a, b]
            if p > zero:
                x, y = np.float32(x * scale_x), np.float32(y * scale_y)
                response = responses[i * (columns // 2) + j]
                for n in range(out.size):
                    out[n] += x * response[0, n] + y * response[1, n]
                    squeezed[n] += p * response[2, n]
    half = out.size // 2
    for n in range(half):
        pressed = normal[here[n] // columns, here[n] % columns] / highest
        free = np.float32(_FREE * (1.0 - pressed))
        out[n] += free * squeezed[n]
        out[half + n] += free * squeezed[half + n]


class GelMotion:
    """Displacement of points on a gel's surface under the forces of a contact.

    MuJoCo's gel shears as one plate. Shear is scaled so that a traction proportional to the
    pressure moves the patch, in the pressure-weighted mean, as far as the plate.
    """

    def __init__(self, sensor: SensorModel, grid: Grid, points: Float[np.ndarray, "n 2"]) -> None:
        """Prepare for points (x, y) of the gel at rest, m, and height fields on `grid`."""
        self._stiffness = np.float32(sensor.shear_stiffness)
        pitch = grid.pitch
        cells = _raster(grid.rows // 4, grid.columns // 4, 4 * pitch)
        offset = points[:, None] - cells
        xx, xy, yy, x, y = _responses(sensor, pitch, 4 * pitch, offset).swapaxes(1, 2)
        along_x, along_y = np.stack([xx, xy, x], 1), np.stack([xy, yy, y], 1)
        # By cell and load: displacement of all points along x, then of all along y.
        self._responses = np.ascontiguousarray(np.concatenate([along_x, along_y], 2))
        blocks = _raster(-(-grid.rows // 8), -(-grid.columns // 8), 8 * pitch)
        between = _responses(sensor, pitch, 8 * pitch, blocks[:, None] - blocks)
        self._patch = np.ascontiguousarray(between[[0, 2]])
        rows, columns = grid.rows // 2, grid.columns // 2
        x, y = (points / (2 * pitch) + np.array([columns - 1, rows - 1]) / 2).round().astype(int).T
        self._here = np.clip(y, 0, rows - 1) * columns + np.clip(x, 0, columns - 1)

    def __call__(self, field: ForceField) -> Float32[np.ndarray, "n 2"]:
        """Return the displacement of the points, m."""
        out = np.zeros(2 * len(self._here), np.float32)
        if field.normal.any():
            tractions = field.normal, field.tangential
            _move(*tractions, self._responses, self._patch, self._stiffness, self._here, out)
        return np.ascontiguousarray(out.reshape(2, -1).T)


@njit(cache=True, fastmath=True)
@no_type_check
def _draw(image, columns, centres, radius, darkness):
    h, w = image.shape  # three channels per pixel
    half, one, zero = np.float32(0.5), np.float32(1.0), np.float32(0.0)
    reach = radius + one
    scale = half / radius
    for n in range(centres.shape[0]):
        x, y = centres[n, 0], centres[n, 1]
        if not (-reach < x < w // 3 + reach and -reach < y < h + reach):
            continue
        left, right = max(int(x - reach), 0) * 3, min(int(x + reach) * 3 + 6, w)
        for i in range(max(int(y - reach), 0), min(int(y + reach) + 2, h)):
            dy = np.float32(i) - y
            room = radius * radius - dy * dy
            row, column = image[i, left:right], columns[left:right]
            for k in range(row.size):
                dx = column[k] - x
                # Distance to the rim without a square root: exact to first order at the rim.
                inside = half + scale * (room - dx * dx)
                passed = one - darkness * min(max(inside, zero), one)
                row[k] = np.uint8(np.float32(row[k]) * passed + half)


def draw(
    image: UInt8[np.ndarray, "h w 3"], centres: Float32[np.ndarray, "n 2"], radius: float | int
) -> None:
    """Darken dots in place, with smooth rims; dots may lie partly or wholly outside the image.

    Args:
        centres: (x, y) in px, pixel centres at integers.
        radius: px, at least 1.
    """
    h, w, _ = image.shape
    columns = np.repeat(np.arange(w, dtype=np.float32), 3)
    _draw(image.reshape(h, 3 * w), columns, centres, np.float32(radius), np.float32(DARKNESS))
