"""Compiled parts of one Gauss-Newton step from a gel's image towards its surface (see `depth`).

Shapes: maps are (rows, columns), colours (3, rows, columns), all float32.
"""

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def shading(gx, gy, gain, places, coefficients, max_slope):
    """Return the colour change by slopes (counts) and its derivatives by them: three of colours.

    Args:
        gx, gy: slopes of the surface along columns and rows, maps.
        gain: of the light, colours.
        places: `position_terms` of each cell (waves, rows, columns).
        coefficients: the sensor file's, ordered as by `depth`.
        max_slope: beyond it only the direction counts.
    """
    h, w = gx.shape
    waves = len(places)
    value, by_gx, by_gy = np.empty_like(gain), np.empty_like(gain), np.empty_like(gain)
    steepest, terms = max_slope**2, np.ones(10, np.float32)
    for i in range(h):
        for j in range(w):
            x, y = gx[i, j], gy[i, j]
            square = x * x + y * y
            if square > (1 + square) * steepest:  # n = -g / length
                squared, bend = square / steepest, 1 / max(square, 1e-6)
            else:
                squared, bend = 1 + square, 1 / (1 + square)
            inverse = -1 / np.sqrt(squared)
            _fill_terms(terms, x * inverse, y * inverse)
            bend *= inverse  # dn/dg = -(1 - bend g g^T) / length
            xx, xy, yy = inverse - bend * x * x, -bend * x * y, inverse - bend * y * y
            for c in range(3):
                v = by_x = by_y = 0.0
                for p in range(waves):
                    place = places[p, i, j] * gain[c, i, j]
                    row = c * waves + p
                    v += place * _dot(coefficients[row], terms)
                    by_x += place * _dot(coefficients[3 * waves + row], terms)
                    by_y += place * _dot(coefficients[6 * waves + row], terms)
                value[c, i, j] = v
                by_gx[c, i, j] = by_x * xx + by_y * xy
                by_gy[c, i, j] = by_x * xy + by_y * yy
    return value, by_gx, by_gy


@njit(cache=True, nogil=True)
@no_type_check
def best_slopes(left, error, gx, gy, gain, places, coefficients, lengths, outlier, tilted, better):
    """Return better slopes along the present directions, and whether any pixel was searched.

    Args:
        left: colour change to explain, colours.
        error: rest with the present slopes, colours.
        gx, gy: slopes, maps.
        gain, places, coefficients: see `shading`.
        lengths: of the normal's part in the image plane to try.
        outlier: squared error that starts a search, counts^2.
        tilted: squared slope below which the direction is noise.
        better: other slopes are taken if they leave at most this share of the squared error.
    """
    h, w = gx.shape
    waves, terms = len(places), np.ones(10, np.float32)
    new_x, new_y, found = gx.copy(), gy.copy(), False
    for i in range(h):
        for j in range(w):
            square = gx[i, j] ** 2 + gy[i, j] ** 2
            before = 0.0
            for c in range(3):
                before += error[c, i, j] ** 2
            if before <= outlier or square <= tilted:
                continue
            found = True
            slope, least, best = np.sqrt(square), np.inf, 0.0
            for n in lengths:
                _fill_terms(terms, -n * gx[i, j] / slope, -n * gy[i, j] / slope)
                after = 0.0
                for c in range(3):
                    v = 0.0
                    for p in range(waves):
                        v += places[p, i, j] * _dot(coefficients[c * waves + p], terms)
                    after += (left[c, i, j] - gain[c, i, j] * v) ** 2
                if after < least:
                    least, best = after, n
            if least < better * before:
                factor = best / np.sqrt(1 - best * best) / slope
                new_x[i, j], new_y[i, j] = gx[i, j] * factor, gy[i, j] * factor
    return new_x, new_y, found


@njit(cache=True, nogil=True)
@no_type_check
def normal_equations(error, by_gx, by_gy, by_depth, weight):
    """Sum weighted products of errors and derivatives over the colours.

    Returns gx gx, gx gy, gy gy, gx depth, gy depth, depth depth (6 maps); gx, gy, depth times error
    (3 maps).
    """
    h, w = weight.shape
    curvature, slope = np.empty((6, h, w), np.float32), np.empty((3, h, w), np.float32)
    for i in range(h):
        for j in range(w):
            a = b = c = d = e = f = rx = ry = rd = 0.0
            for k in range(3):
                x, y, z = by_gx[k, i, j], by_gy[k, i, j], by_depth[k, i, j]
                r = error[k, i, j]
                a, b, c = a + x * x, b + x * y, c + y * y
                d, e, f = d + x * z, e + y * z, f + z * z
                rx, ry, rd = rx + x * r, ry + y * r, rd + z * r
            m = weight[i, j]
            curvature[0, i, j], curvature[1, i, j], curvature[2, i, j] = m * a, m * b, m * c
            curvature[3, i, j], curvature[4, i, j], curvature[5, i, j] = m * d, m * e, m * f
            slope[0, i, j], slope[1, i, j], slope[2, i, j] = m * rx, m * ry, m * rd
    return curvature, slope


@njit(cache=True, nogil=True)
@no_type_check
def conjugate_gradients(curvature, residual, smooth, down, across, half, count):
    """Return the surface's change (m) that explains the residual, after `count` steps.

    Args:
        curvature: of `normal_equations`.
        residual: map; overwritten.
        smooth: eigenvalues of the preconditioner under the cosine transform, map.
        down, across: cosine transform of columns and of rows, as matrices.
        half: factor of central differences, 1/m.
        count: of steps.
    """
    step, direction = np.zeros_like(residual), np.zeros_like(residual)
    x, y = np.empty_like(residual), np.empty_like(residual)
    curved = np.empty_like(residual)
    size = 1.0
    a, b, c, d, e, f = curvature
    for _ in range(count):
        z = np.dot(np.dot(down, residual), across.T) * smooth
        z = np.dot(np.dot(down.T, z), across)
        before, size = size, _total(residual, z)
        if size == 0:  # nothing left to explain: a frame equal to its background
            break
        direction = z + np.float32(size / before) * direction
        slopes(direction, half, x, y)
        for i in range(x.shape[0]):
            for j in range(x.shape[1]):
                gx, gy, h = x[i, j], y[i, j], direction[i, j]
                x[i, j] = a[i, j] * gx + b[i, j] * gy + d[i, j] * h
                y[i, j] = b[i, j] * gx + c[i, j] * gy + e[i, j] * h
                curved[i, j] = d[i, j] * gx + e[i, j] * gy + f[i, j] * h
        add_against_slopes(x, y, half, curved)
        length = np.float32(size / _total(direction, curved))
        step += length * direction
        residual -= length * curved
    return step


@njit(cache=True, nogil=True)
@no_type_check
def slopes(surface, half, x, y):
    """Write central differences along columns and rows into x and y, the edge replicated."""
    h, w = surface.shape
    for i in range(h):
        above, below = max(i - 1, 0), min(i + 1, h - 1)
        for j in range(w):
            left, right = max(j - 1, 0), min(j + 1, w - 1)
            x[i, j] = (surface[i, right] - surface[i, left]) * half
            y[i, j] = (surface[below, j] - surface[above, j]) * half


@njit(cache=True, nogil=True)
@no_type_check
def add_against_slopes(x, y, half, out):
    """Add the transpose of `slopes` to `out`."""
    h, w = out.shape
    for i in range(h):
        above, below = max(i - 1, 0), min(i + 1, h - 1)
        for j in range(w):
            left, right = max(j - 1, 0), min(j + 1, w - 1)
            along, across = half * x[i, j], half * y[i, j]
            out[i, right] += along
            out[i, left] -= along
            out[below, j] += across
            out[above, j] -= across


@njit(inline="always")
@no_type_check
def _fill_terms(terms, x, y):
    """Write 1 and `sensor_calibration.monomials` into `terms`."""
    xx, xy, yy = x * x, x * y, y * y
    terms[1], terms[2], terms[3], terms[4], terms[5] = x, y, xx, xy, yy
    terms[6], terms[7], terms[8], terms[9] = xx * x, xx * y, x * yy, yy * y


@njit(inline="always")
@no_type_check
def _dot(row, terms):
    total = 0.0
    for t in range(10):
        total += row[t] * terms[t]
    return total


@njit(inline="always")
@no_type_check
def _total(a, b):
    total = 0.0
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            total += a[i, j] * b[i, j]
    return total
