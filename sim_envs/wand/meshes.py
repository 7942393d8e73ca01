"""Closed meshes made in code, fine enough that a gel does not feel their facets."""

import numpy as np
from jaxtyping import Float, Float32, Int32
from scipy.interpolate import PchipInterpolator

Mesh = tuple[Float32[np.ndarray, "_ 3"], Int32[np.ndarray, "_ 3"]]

FINE, COARSE = 0.8e-3, 3e-3
"""m, edges of facets: for the gel (on a ball of 20 mm they stand off by 4 um), and for cameras."""
_LEAST_AROUND, _MOST_AROUND = 24, 200


def ellipsoid(axes: tuple[float, ...], edge: float = FINE) -> Mesh:
    """Return an ellipsoid of these half axes (m) about its centre."""
    steps = _around(max(axes), edge) // 2
    angle = np.linspace(0, np.pi, steps + 1)
    rings = np.column_stack([np.sin(angle), -np.cos(angle)])
    vertices, faces = _revolve(rings, 2 * steps)
    return (vertices * np.array(axes, np.float32)).astype(np.float32), faces


def lathe(profile: Float[np.ndarray, "k 2"], edge: float = FINE) -> Mesh:
    """Return a surface of revolution about z.

    Args:
        profile: radius and z (m) along a path, smooth between the points; a hollow object goes up
            outside and down inside. Both ends are closed to the axis.
        edge: of the facets, m.
    """
    along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(profile, axis=0).T))])
    steps = int(np.clip(along[-1] / (1.5 * edge), 2, 150))
    at = np.union1d(np.linspace(0, along[-1], steps), along)  # corners stay corners
    smooth = PchipInterpolator(along, profile)(at)  # never overshoots
    ends = [[0, smooth[0, 1]]], smooth, [[0, smooth[-1, 1]]]
    return _revolve(np.concatenate(ends), _around(profile[:, 0].max(), edge))


def prism(sides: int, radius: float, half_length: float) -> Mesh:
    """Return a regular prism about z: `radius` (m) of its corners, half its length (m)."""
    ends = [[0, -half_length], [radius, -half_length], [radius, half_length], [0, half_length]]
    return _revolve(np.array(ends), sides)


def _around(radius: float, edge: float) -> int:
    return int(np.clip(2 * np.pi * radius / edge, _LEAST_AROUND, _MOST_AROUND)) // 2 * 2


def _revolve(rings: Float[np.ndarray, "k 2"], around: int) -> Mesh:
    """Turn radii and heights about z; the first and the last radius are 0."""
    angle = np.arange(around) * 2 * np.pi / around
    inner = rings[1:-1]
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    sides = np.concatenate(
        [inner[:, None, :1] * circle, np.broadcast_to(inner[:, None, 1:], (len(inner), around, 1))],
        axis=2,
    ).reshape(-1, 3)
    vertices = np.concatenate([[[0, 0, rings[0, 1]]], sides, [[0, 0, rings[-1, 1]]]])
    now, after = np.arange(around), (np.arange(around) + 1) % around
    bottom, top = 0, len(vertices) - 1
    faces = [np.column_stack([np.full(around, bottom), 1 + after, 1 + now])]
    for i in range(len(inner) - 1):
        low, high = 1 + i * around, 1 + (i + 1) * around
        faces.append(np.column_stack([low + now, low + after, high + after]))
        faces.append(np.column_stack([low + now, high + after, high + now]))
    last = 1 + (len(inner) - 1) * around
    faces.append(np.column_stack([last + now, last + after, np.full(around, top)]))
    return vertices.astype(np.float32), np.concatenate(faces).astype(np.int32)
