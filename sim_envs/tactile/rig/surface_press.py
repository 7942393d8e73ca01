"""Presses of random surfaces by the pad simulator alone, a millisecond each.

The depth is drawn, not solved for; `press_bench` presses with a force.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from touchgoal.control.tactile.gel import deform
from touchgoal.sim_envs.tactile.optics import render
from touchgoal.sim_envs.tactile.rig.surfaces import TILE, TILE_PITCH, Surface
from touchgoal.sim_envs.tactile.sensor_instance import SensorInstance

DEPTHS = 0.15e-3, 1.3e-3  # range of the indentation by a light hand, m
_NOTHING = -5e-3  # m: far below the gel
_CARRYING = 0.6e-6  # m2 of a surface's highest points that carry a press


@dataclass(frozen=True)
class SurfacePose:
    """Pose of a surface against the gel."""

    centre: tuple[float, float]  # of the body on the gel, m along x and y from the image's middle
    turn: float  # about the gel's normal, rad
    tilt: tuple[float, float]  # slopes along x and y, m per m
    texture_at: tuple[float, float]  # cell of the texture in the body's middle
    depth: float  # depth of the highest point in the undeformed gel, m


def random_pose(rng: np.random.Generator) -> SurfacePose:
    """Draw a pose as by hand: near the middle, at any angle, not quite level."""
    x, y = rng.normal(0, 2.5e-3, 2)
    a, b = rng.normal(0, 0.012, 2)
    u, v = rng.uniform(0, TILE, 2)
    low, high = np.log(DEPTHS)
    turn = float(rng.uniform(0, 2 * math.pi))
    return SurfacePose((x, y), turn, (a, b), (u, v), float(np.exp(rng.uniform(low, high))))


def overlap(
    surface: Surface, pose: SurfacePose, shape: tuple[int, int], pitch: float
) -> Float32[np.ndarray, "h w"]:
    """Return the depth of the surface in the undeformed gel, m; zero where it does not reach it.

    Args:
        shape: rows and columns of the grid, centred on the image.
        pitch: size of a cell, m.
    """
    h, w = shape
    x = (np.arange(w, dtype=np.float32) - (w - 1) / 2) * np.float32(pitch)
    y = ((np.arange(h, dtype=np.float32) - (h - 1) / 2) * np.float32(pitch))[:, None]
    x, y = x - np.float32(pose.centre[0]), y - np.float32(pose.centre[1])
    c, s = np.float32(math.cos(pose.turn)), np.float32(math.sin(pose.turn))
    height = _body(surface, c * x + s * y, c * y - s * x)
    height += np.float32(pose.tilt[0]) * x + np.float32(pose.tilt[1]) * y
    step = pitch / TILE_PITCH  # cell under pixel (column j, row i) is linear in j and i
    middle = (w - 1) / 2 + pose.centre[0] / pitch, (h - 1) / 2 + pose.centre[1] / pitch
    turned = step * np.array([[c, s], [-s, c]])
    shift = np.array(pose.texture_at) - turned @ middle
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    to_cells = np.column_stack([turned, shift])
    height += cv2.warpAffine(
        surface.texture, to_cells, (w, h), flags=flags, borderMode=cv2.BORDER_WRAP
    )
    # The highest points, not the one highest: a single grain does not carry the press.
    carrying = min(round(_CARRYING / pitch**2), height.size)
    top = float(np.partition(height.ravel(), -carrying)[-carrying])
    height += np.float32(pose.depth - top)
    return np.maximum(height, 0) * np.float32(surface.firmness)


def _body(surface: Surface, x: np.ndarray, y: np.ndarray) -> Float32[np.ndarray, "h w"]:
    """Return the height of the body's coarse shape over its own axes, 0 at its highest."""
    if surface.body == "ball":
        height = -(x * x + y * y) / np.float32(2 * surface.size)
    elif surface.body == "cylinder":
        height = -(x * x + 0 * y) / np.float32(2 * surface.size)
    elif surface.body == "edge":
        height = -np.maximum(x + 0 * y, 0) * np.float32(surface.slope)
    elif surface.body == "bar":
        beside = np.maximum(np.abs(x + 0 * y) - np.float32(surface.size / 2), 0)
        height = -beside * np.float32(1 + 3 * surface.slope)
    elif surface.body == "corner":
        height = -np.maximum(np.maximum(x, y), 0) * np.float32(1 + surface.slope)
    else:
        height = 0 * (x + y)
    return np.maximum(height, _NOTHING)


def press(
    surface: Surface, pose: SurfacePose, instance: SensorInstance, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """Render one sensor's image of a press, RGB; without shear its dots hardly move."""
    _, h, w = instance.background.shape
    pitch = instance.pixel_pitch
    raw = overlap(surface, pose, (h, w), pitch)
    deformed = deform(raw, pitch, instance.calibration.blur_sigmas, textured=True)
    return instance.with_dots(render(deformed, instance, rng))
