"""How an object sits in a gel: pushed in and tilted until pressure balances the solver's force.

Sensor frame as in `geometry`; m, N, Nm, Pa.
"""

import math
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float32
from numba import njit

from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.sim_envs.scene.contacts import PadContact
from touchgoal.sim_envs.tactile.geometry import NO_SURFACE, HeightField

MAX_TILT = math.radians(3.0)
MAX_OVERLAP = 0.02  # m; beyond any gripper's force
# Nm/rad with which the holder resists tilting of the object in the gel: about that of a second gel.
# A flat face or a line (3 to 9 Nm/rad of its own) tilts until the moments balance. A ball (0.1 to
# 0.7), whose tilt would only shift its print, hardly tilts, and a vertex does not tip over.
TILT_STIFFNESS = 1.0
_FIRST_OVERLAP = 3e-4  # m, where the search begins
_CENTRE_TOLERANCE = 5e-6  # m


@dataclass(frozen=True)
class Press:
    """Pose of an object in a gel, with the pressure under it."""

    shift: float  # how far it is pushed in, m
    tilt: tuple[float, float]  # along x and y: adds `shift + tilt[0] x + tilt[1] y` to its height
    pressure: Float32[np.ndarray, "h w"]  # on the gel's own cells, Pa; zero where nothing touches
    pitch: float  # size of a cell, m
    displacement: tuple[float, float, float]  # of the cells (x, y, z), m: as the solver's plate

    def push_in(self, height: HeightField, pitch: float) -> None:
        """Move the object's height field, of any grid centred on the sensor frame, in place."""
        _add_plane(height, _columns(height, pitch), pitch, self.shift, *self.tilt)


def _columns(height: HeightField, pitch: float) -> Float32[np.ndarray, " w"]:
    """Return x of the columns, m, as a table: AVX2 cannot convert loop counters to floats."""
    n = height.shape[1]
    return ((np.arange(n) - (n - 1) / 2) * pitch).astype(np.float32)


@njit(cache=True, fastmath=True)
@no_type_check
def _add_plane(height, xs, pitch, shift, a, b):
    slope = np.float32(a)
    for i in range(height.shape[0]):
        base, row = np.float32(shift + b * (i - 0.5 * (height.shape[0] - 1)) * pitch), height[i]
        for j in range(height.shape[1]):
            row[j] += base + slope * xs[j]


@njit(inline="always", fastmath=True)
@no_type_check
def solve3(a, b, c, d, e, f, u, v, w):
    """Solve the symmetric positive [[a, b, c], [b, d, e], [c, e, f]] against (u, v, w)."""
    ba, ca = b / a, c / a
    d2, e2, f2 = d - ba * b, e - ba * c, f - ca * c
    ed = e2 / d2
    y2, z2 = v - ba * u, w - ca * u
    z = (z2 - ed * y2) / (f2 - ed * e2)
    y = (y2 - e2 * z) / d2
    return (u - b * y - c * z) / a, y, z


@njit(cache=True, fastmath=True)
@no_type_check
def _shear(height, shift_x, shift_y, out):
    """Shift the height field by cells, interpolated; at outlines the nearest cell."""
    rows, columns = height.shape
    one, none = np.float32(1.0), NO_SURFACE * np.float32(0.5)
    shift_x = min(max(shift_x, -1.0 * columns), columns - 1.0)
    iy, ix = int(math.floor(shift_y)), int(math.floor(shift_x))
    fx, fy = np.float32(shift_x - ix), np.float32(shift_y - iy)
    round_x, round_y = np.float32(fx > 0.5), np.float32(fy > 0.5)
    first, last = min(max(-ix, 0), columns), max(min(columns - ix, columns + 1), 1)
    line = np.empty(columns + 1, np.float32)
    inside, left, right = line[first:last], line[:-1], line[1:]
    for i in range(rows):
        above = height[min(max(i + iy, 0), rows - 1), first + ix : last + ix]
        below = height[min(max(i + iy + 1, 0), rows - 1), first + ix : last + ix]
        for j in range(inside.size):
            smooth = min(above[j], below[j]) > none
            share = fy if smooth else round_y
            inside[j] = (one - share) * above[j] + share * below[j]
        line[:first], line[last:] = line[first], line[last - 1]
        row = out[i]
        for j in range(columns):
            smooth = min(left[j], right[j]) > none
            share = fx if smooth else round_x
            row[j] = (one - share) * left[j] + share * right[j]


@njit(inline="always", fastmath=True)
@no_type_check
def _overlap_sums(height, top, xs, pitch, shift, a, b, total):
    """Sum over the contact: 1, x, y, xx, xy, yy of its cells; overlap times 1, x, y."""
    rows, columns = height.shape
    zero, one = np.float32(0.0), np.float32(1.0)
    reach, slope = abs(a) * xs[-1], np.float32(a)
    total[:] = 0.0
    for i in range(rows):
        y = (i - 0.5 * (rows - 1)) * pitch
        base = np.float32(shift + b * y)
        if top[i] + base + reach <= 0.0:
            continue
        n, nx, nxx, o, ox = zero, zero, zero, zero, zero
        row = height[i]
        for j in range(columns):
            x = xs[j]
            overlap = max(row[j] + base + slope * x, zero)
            on = one if overlap > zero else zero
            n += on
            nx += on * x
            nxx += on * x * x
            o += overlap
            ox += overlap * x
        total[0] += n
        total[1] += nx
        total[2] += n * y
        total[3] += nxx
        total[4] += nx * y
        total[5] += n * y * y
        total[6] += o
        total[7] += ox
        total[8] += o * y


@njit(inline="always", fastmath=True)
@no_type_check
def _push(height, top, xs, pitch, volume, shift, a, b, most, tolerance, total):
    """Find the shift at which the overlap sums to `volume`, by Newton's method."""
    for _ in range(60):
        _overlap_sums(height, top, xs, pitch, shift, a, b, total)
        error = total[6] - volume
        if abs(error) <= tolerance * volume or (shift >= most and error < 0.0):
            break
        shift = min(shift - error / max(total[0], 1.0), most)
    return shift


@njit(inline="always", fastmath=True)
@no_type_check
def _room(value, step, limit):
    return (math.copysign(limit, step) - value) / step if step != 0.0 else 1.0


@njit(cache=True, fastmath=True)
@no_type_check
def _balance_press(height, xs, pitch, volume, mx, my, stiffness, limit):
    """Find shift and slopes; forces in units of a cell's area times the foundation modulus."""
    top = np.empty(height.shape[0], np.float32)
    for i in range(height.shape[0]):
        top[i] = height[i].max()
    highest = top.max()
    most = MAX_OVERLAP - highest
    total, trial = np.empty(9), np.empty(9)
    a = b = 0.0
    shift = _push(height, top, xs, pitch, volume, _FIRST_OVERLAP - highest, a, b, most, 0.05, total)
    for _ in range(25):
        g0 = total[6] - volume
        g1 = total[7] - mx + stiffness * a
        g2 = total[8] - my + stiffness * b
        # A slope at its limit stays there if it would go beyond.
        free1 = not ((a >= limit and g1 < 0.0) or (a <= -limit and g1 > 0.0))
        free2 = not ((b >= limit and g2 < 0.0) or (b <= -limit and g2 > 0.0))
        g1, g2 = g1 * free1, g2 * free2
        if abs(g0) < 1e-3 * volume and max(abs(g1), abs(g2)) < _CENTRE_TOLERANCE * volume:
            break
        n, x, y = max(total[0], 1.0), total[1] * free1, total[2] * free2
        xx, xy, yy = total[3] + stiffness, total[4] * (free1 and free2), total[5] + stiffness
        s0, s1, s2 = solve3(n, x, y, xx, xy, yy, -g0, -g1, -g2)
        start = g0 * s0 + g1 * s1 + g2 * s2
        step = min(1.0, _room(a, s1, limit), _room(b, s2, limit))
        # Line search on a convex energy: shorten a step that ends where the energy rises.
        for _ in range(12):
            t0, t1, t2 = min(shift + step * s0, most), a + step * s1, b + step * s2
            _overlap_sums(height, top, xs, pitch, t0, t1, t2, trial)
            end = (trial[6] - volume) * s0
            end += (trial[7] - mx + stiffness * t1) * s1 + (trial[8] - my + stiffness * t2) * s2
            if end <= -0.2 * start:
                break
            step *= start / (start - end)
        shift, a, b = t0, t1, t2
        total[:] = trial
    return _push(height, top, xs, pitch, volume, shift, a, b, most, 1e-6, total), a, b


@njit(cache=True, fastmath=True)
@no_type_check
def _pressure(height, xs, pitch, shift, a, b, modulus, force, out):
    rows, columns = height.shape
    zero, slope, stiffness = np.float32(0.0), np.float32(a), np.float32(modulus)
    total = 0.0
    for i in range(rows):
        base = np.float32(shift + b * (i - 0.5 * (rows - 1)) * pitch)
        row, source, line = out[i], height[i], zero
        for j in range(columns):
            row[j] = stiffness * max(source[j] + base + slope * xs[j], zero)
            line += row[j]
        total += line
    if total > 0.0:  # the factor is 1, unless the overlap is at its maximum, or rounds to 0
        out *= np.float32(force / (total * pitch * pitch))


def press_until_balanced(
    height: HeightField, pitch: float, contact: PadContact, modulus: float, sensor: SensorModel
) -> Press:
    """Push an object into the gel, and tilt it, until the pressure balances the solver's force.

    Pressure = modulus x overlap. MuJoCo's penetration is not this overlap: it depends on solver
    settings and mass. The normal force is met exactly, its moments as far as the patch and
    `MAX_TILT` let them.

    Args:
        height: object height over the whole gel, m; all NO_SURFACE: nothing presses.
        pitch: size of a cell, m.
        contact: the solver's, with a normal force above zero.
        modulus: foundation modulus of gel and object in series, Pa/m.
    """
    force, torque, normal = contact.force, contact.torque, contact.normal_force
    dx, dy = float(force[0]) / sensor.shear_stiffness, float(force[1]) / sensor.shear_stiffness
    dz = -normal / sensor.normal_stiffness
    displacement = dx, dy, dz
    sheared, pressure = np.empty_like(height), np.zeros_like(height)
    _shear(height, dx / pitch, dy / pitch, sheared)
    if sheared.max() <= NO_SURFACE / 2:
        return Press(0.0, (0.0, 0.0), pressure, pitch, displacement)
    stiffness = modulus * pitch * pitch
    volume = normal / stiffness
    # First moments of the normal force about the sheared gel's centre; shear pulls at depth dz.
    mx = (float(torque[1]) - dz * float(force[0])) / stiffness - volume * dx
    my = (-float(torque[0]) - dz * float(force[1])) / stiffness - volume * dy
    xs = _columns(height, pitch)
    shift, a, b = _balance_press(
        sheared, xs, pitch, volume, mx, my, TILT_STIFFNESS / stiffness, MAX_TILT
    )
    _pressure(sheared, xs, pitch, shift, a, b, modulus, normal, pressure)
    return Press(shift - a * dx - b * dy, (a, b), pressure, pitch, displacement)
