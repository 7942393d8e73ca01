"""Closed meshes made in code, fine enough that a gel does not feel their facets."""

import numpy as np
from jaxtyping import Float, Float32, Int32
from scipy.interpolate import PchipInterpolator

Mesh = tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, "m 3"]]

_EDGE = 0.8e-3  # m: on a ball of 20 mm, facets of that length stand off by 4 um
_MOST_AROUND = 240


def ellipsoid(axes: tuple[float, ...]) -> Mesh:
    """Return an ellipsoid of these half axes (m) about its centre."""
    steps = int(np.clip(np.pi * max(axes) / _EDGE, 12, _MOST_AROUND // 2))
    angle = np.linspace(0, np.pi, steps + 1)
    rings = np.column_stack([np.sin(angle), -np.cos(angle)])
    vertices, faces = _revolve(rings, 2 * steps)
    return (vertices * np.array(axes, np.float32)).astype(np.float32), faces


def lathe(profile: Float[np.ndarray, "n 2"]) -> Mesh:
    """Return a surface of revolution about z.

    Args:
        profile: radius and z (m) from bottom to top; smooth between the points, closed to the axis.
    """
    along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(profile, axis=0).T))])
    steps = int(np.clip(along[-1] / (1.5 * _EDGE), len(profile), 120))
    at = np.union1d(np.linspace(0, along[-1], steps), along)  # corners stay corners
    smooth = PchipInterpolator(along, profile)(at)  # never overshoots
    ends = [[0, smooth[0, 1]]], smooth, [[0, smooth[-1, 1]]]
    around = int(np.clip(2 * np.pi * profile[:, 0].max() / _EDGE, 24, _MOST_AROUND))
    return _revolve(np.concatenate(ends), around)


def prism(sides: int, radius: float, half_length: float) -> Mesh:
    """Return a regular prism about z: `radius` (m) of its corners, half its length (m)."""
    ends = [[0, -half_length], [radius, -half_length], [radius, half_length], [0, half_length]]
    return _revolve(np.array(ends), sides)


def _revolve(rings: Float[np.ndarray, "n 2"], around: int) -> Mesh:
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
