"""Forces between a gel and an object, cell by cell: pressure, shear, stick and slip.

Shear is a brush model: every cell is a bristle whose tip sticks to the object until friction
releases it; the object moves until the bristles carry the solver's tangential force and torsion.
Sensor frame as in `geometry`; m, N, Nm, Pa.
"""

import math
from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float, Float32
from numba import njit

from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.sim_envs.scene.contacts import PadContact
from touchgoal.sim_envs.tactile.geometry import Grid
from touchgoal.sim_envs.tactile.press import Press, solve3

_MAX_CORRECTION = 0.9  # share of a cell's normal force
# Keep the bristles' motion finite where friction cannot carry the load; shares of their stiffness.
# Where the patch cannot carry both, torsion yields to force.
_REGULARIZATION, _REGULARIZATION_TORSION = 1e-5, 1e-3
_FORCE_TOLERANCE = 1e-4  # share of the friction limit


@dataclass(frozen=True)
class ForceField:
    """Forces of an object on the cells of a gel, which move with it when it shears."""

    normal: Float32[np.ndarray, "h w"]  # N per cell, + pressed; grid centred on the sensor frame
    tangential: Float32[np.ndarray, "2 h w"]  # N per cell, along the sensor's x and y
    pitch: float  # size of a cell, m
    displacement: tuple[float, float, float]  # (x, y, z) of the whole gel from rest, m

    def wrench(self) -> Float[np.ndarray, "6"]:
        """Sum of the field: force (N) and torque (Nm) on the pad about the sensor's origin."""
        h, w = self.normal.shape
        x = (np.arange(w) - (w - 1) / 2) * self.pitch + self.displacement[0]
        y = (np.arange(h)[:, None] - (h - 1) / 2) * self.pitch + self.displacement[1]
        z, (fx, fy), fz = self.displacement[2], self.tangential.astype(float), -self.normal
        moments = y * fz - z * fy, z * fx - x * fz, x * fy - y * fx
        return np.array([np.sum(a) for a in (fx, fy, fz, *moments)], float)


@njit(cache=True, fastmath=True)
@no_type_check
def _pool(pressure, area, out):
    """Sum pressure (Pa) on 2 x 2 cells of `area` m^2 to the force (N) on one force cell."""
    for i in range(out.shape[0]):
        row, above, below = out[i], pressure[2 * i], pressure[2 * i + 1]
        for j in range(out.shape[1]):
            pressed = above[2 * j] + above[2 * j + 1] + below[2 * j] + below[2 * j + 1]
            row[j] = pressed * area


@njit(cache=True, fastmath=True)
@no_type_check
def _match_moments(normal, pitch, place, mx, my):
    """Weight the forces, linearly across the patch, so that their moments become mx and my."""
    rows, columns = normal.shape
    load = sx = sy = sxx = sxy = syy = 0.0
    for i in range(rows):
        y = (i - 0.5 * (rows - 1)) * pitch + place[1]
        for j in range(columns):
            p = normal[i, j]
            if p > 0.0:
                x = (j - 0.5 * (columns - 1)) * pitch + place[0]
                load += p
                sx += p * x
                sy += p * y
                sxx += p * x * x
                sxy += p * x * y
                syy += p * y * y
    if load == 0.0:
        return
    cx, cy = sx / load, sy / load
    least = 1e-3 * load * pitch * pitch  # keeps the solution finite for lines and single cells
    vxx, vxy, vyy = sxx - cx * sx + least, sxy - cx * sy, syy - cy * sy + least
    determinant = vxx * vyy - vxy * vxy
    a = (vyy * (mx - sx) - vxy * (my - sy)) / determinant
    b = (vxx * (my - sy) - vxy * (mx - sx)) / determinant
    most = 0.0
    for i in range(rows):
        y = (i - 0.5 * (rows - 1)) * pitch + place[1] - cy
        for j in range(columns):
            if normal[i, j] > 0.0:
                x = (j - 0.5 * (columns - 1)) * pitch + place[0] - cx
                most = max(most, abs(a * x + b * y))
    share = _MAX_CORRECTION / max(most, _MAX_CORRECTION)
    for i in range(rows):
        y = (i - 0.5 * (rows - 1)) * pitch + place[1] - cy
        for j in range(columns):
            x = (j - 0.5 * (columns - 1)) * pitch + place[0] - cx
            normal[i, j] *= 1.0 + share * (a * x + b * y)


@njit(inline="always", fastmath=True)
@no_type_check
def _bristles(normal, before, pitch, place, friction):
    """Return pressed cells (x, y from the centre, traction, friction limit), centre and load."""
    rows, columns = normal.shape
    found = np.empty((5, rows * columns), np.float32)
    load = cx = cy = 0.0
    n = 0
    for i in range(rows):
        for j in range(columns):
            p = normal[i, j]
            if p > 0.0:
                x = (j - 0.5 * (columns - 1)) * pitch + place[0]
                y = (i - 0.5 * (rows - 1)) * pitch + place[1]
                limit = friction * p
                # The earlier traction, cut to the present friction cone.
                size = math.sqrt(before[0, i, j] ** 2 + before[1, i, j] ** 2)
                share = limit / max(size, limit)
                found[0, n], found[1, n] = x, y
                found[2, n], found[3, n] = before[0, i, j] * share, before[1, i, j] * share
                found[4, n] = limit
                load += p
                cx += p * x
                cy += p * y
                n += 1
    found = found[:, :n].copy()
    if n > 0:
        cx, cy = cx / load, cy / load
        found[0] -= np.float32(cx)
        found[1] -= np.float32(cy)
    return found, cx, cy, load


@njit(inline="always", fastmath=True, error_model="numpy")
@no_type_check
def _brush_sums(bristles, stiffness, ux, uy, turn, total):
    """Sum force, torsion, and their derivatives, of bristles with moved tips."""
    zero, one = np.float32(0.0), np.float32(1.0)
    x, y, qx, qy, limit = bristles[0], bristles[1], bristles[2], bristles[3], bristles[4]
    k, ux, uy, turn = np.float32(stiffness), np.float32(ux), np.float32(uy), np.float32(turn)
    fx, fy, torsion = zero, zero, zero
    hxx, hxy, hyy, hxt, hyt, htt = zero, zero, zero, zero, zero, zero
    for n in range(x.size):
        tx = qx[n] + k * (ux - turn * y[n])
        ty = qy[n] + k * (uy + turn * x[n])
        inverse = one / math.sqrt(tx * tx + ty * ty + np.float32(1e-24))
        share = min(limit[n] * inverse, one)
        sx, sy = share * tx, share * ty
        fx += sx
        fy += sy
        torsion += x[n] * sy - y[n] * sx
        # A slipping bristle resists only across its traction.
        along = share * inverse * inverse if share < one else zero
        axx, axy, ayy = share - along * tx * tx, -along * tx * ty, share - along * ty * ty
        axt, ayt = x[n] * axy - y[n] * axx, x[n] * ayy - y[n] * axy
        hxx += axx
        hxy += axy
        hyy += ayy
        hxt += axt
        hyt += ayt
        htt += x[n] * ayt - y[n] * axt
    total[0], total[1], total[2] = fx, fy, torsion
    total[3], total[4], total[5] = k * hxx, k * hxy, k * hxt
    total[6], total[7], total[8] = k * hyy, k * hyt, k * htt


@njit(inline="always", fastmath=True)
@no_type_check
def _balance(bristles, stiffness, area, force_x, force_y, torsion):
    """Find the rigid motion (x, y, turn) of the tips that makes them carry force and torsion."""
    x, y, limit = bristles[0], bristles[1], bristles[4]
    most, radius = limit.sum(), math.sqrt((x * x + y * y).mean() + area)
    damping = _REGULARIZATION * stiffness * x.size
    damping_turn = _REGULARIZATION_TORSION * stiffness * x.size * radius * radius
    ux = uy = turn = 0.0
    total, trial = np.empty(9), np.empty(9)
    _brush_sums(bristles, stiffness, ux, uy, turn, total)
    for _ in range(40):
        g0 = total[0] - force_x + damping * ux
        g1 = total[1] - force_y + damping * uy
        g2 = total[2] - torsion + damping_turn * turn
        if max(abs(g0), abs(g1), abs(g2) / radius) < _FORCE_TOLERANCE * most:
            break
        xx, yy, tt = total[3] + damping, total[6] + damping, total[8] + damping_turn
        s0, s1, s2 = solve3(xx, total[4], total[5], yy, total[7], tt, -g0, -g1, -g2)
        start = g0 * s0 + g1 * s1 + g2 * s2
        step = 1.0
        for _ in range(12):
            t0, t1, t2 = ux + step * s0, uy + step * s1, turn + step * s2
            _brush_sums(bristles, stiffness, t0, t1, t2, trial)
            h0, h1 = trial[0] - force_x + damping * t0, trial[1] - force_y + damping * t1
            end = h0 * s0 + h1 * s1
            end += (trial[2] - torsion + damping_turn * t2) * s2
            if end <= -0.2 * start:
                break
            step *= start / (start - end)
        ux, uy, turn = t0, t1, t2
        total[:] = trial
    return ux, uy, turn


@njit(cache=True, fastmath=True, error_model="numpy")  # checks for zero prevent vectorisation
@no_type_check
def _brush(normal, before, pitch, place, friction, stiffness, force, torque, out):
    """Write the tractions that balance force and torque to `out`."""
    bristles, cx, cy, load = _bristles(normal, before, pitch, place, friction)
    if load == 0.0:
        return
    torsion = torque - (cx * force[1] - cy * force[0])
    ux, uy, turn = _balance(bristles, stiffness, pitch * pitch, force[0], force[1], torsion)
    carried = np.empty(9)
    _brush_sums(bristles, stiffness, ux, uy, turn, carried)
    # The remaining force and torsion, even beyond friction, are spread in proportion to pressure.
    x, y, limit = bristles[0], bristles[1], bristles[4]
    polar = (limit * (x * x + y * y)).sum() / friction
    left_x, left_y = (force[0] - carried[0]) / load, (force[1] - carried[1]) / load
    left_turn = (torsion - carried[2]) / polar if polar > 0.0 else 0.0
    n = 0
    for i in range(normal.shape[0]):
        for j in range(normal.shape[1]):
            p = normal[i, j]
            if p > 0.0:
                x, y, qx, qy, limit = bristles[:, n]
                tx, ty = qx + stiffness * (ux - turn * y), qy + stiffness * (uy + turn * x)
                size = math.sqrt(tx * tx + ty * ty)
                share = limit / max(size, limit)
                out[0, i, j] = tx * share + p * (left_x - left_turn * y)
                out[1, i, j] = ty * share + p * (left_y + left_turn * x)
                n += 1


def force_field(
    press: Press,
    before: ForceField | None,
    contact: PadContact,
    friction: float,
    sensor: SensorModel,
) -> ForceField:
    """Spread the solver's wrench on a pad over the gel's cells; each is 2 x 2 of the pressure's.

    Force and torsion are met exactly, the moments about x and y as far as the patch reaches. Where
    MuJoCo's torsional friction carries more than the patch can, all cells slip, and the missing
    torsion is added in proportion to their pressure.

    Args:
        press: how the object sits in the gel, with an even number of pressure cells each way.
        before: this pad's field of the frame before; None if nothing touched it.
        friction: coefficient that the solver used.
    """
    rows, columns = (n // 2 for n in press.pressure.shape)
    pitch = 2 * press.pitch
    normal = np.empty((rows, columns), np.float32)
    tangential = np.zeros((2, rows, columns), np.float32)
    _pool(press.pressure, np.float32(press.pitch**2), normal)
    (fx, fy, _), (tx, ty, tz), (_, _, z) = contact.force, contact.torque, press.displacement
    _match_moments(normal, pitch, press.displacement, ty - z * fx, -tx - z * fy)
    _brush(
        normal,
        tangential if before is None else before.tangential,
        pitch,
        press.displacement,
        max(friction, 1e-5),  # MuJoCo's own least
        sensor.shear_modulus / sensor.gel_thickness * pitch * pitch,
        contact.force,
        tz,
        tangential,
    )
    return ForceField(normal, tangential, pitch, press.displacement)


def resample_to_image(
    values: Float[np.ndarray, "h w"], field: ForceField, image: Grid
) -> Float32[np.ndarray, "h2 w2"]:
    """Interpolate values on a field's cells onto a grid centred on the image; 0 beyond the gel."""
    cells = field.pitch / image.pitch  # image cells per gel cell
    middle = np.array(values.shape[::-1]) / 2 - 0.5 - np.array(field.displacement[:2]) / field.pitch
    shift = middle - (np.array([image.columns, image.rows]) / 2 - 0.5) / cells
    to_cells = np.column_stack([np.eye(2) / cells, shift])
    size = image.columns, image.rows
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(values.astype(np.float32), to_cells, size, flags=flags)
