"""Scenes unlike the usual one: table and disc of another look, a front camera that stands elsewhere."""

from typing import Any

import cv2
import mujoco
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from touchgoal.control.motion.rotations import rotation_matrix
from touchgoal.sim_envs.config import CameraPlacement

CALIBRATION_ERROR = 0.005, np.radians(1.0)  # m and rad, RMS
_DISC = 0.018, 0.05  # m, radius
_CONTRAST = 0.25  # of colours in [0, 1], between disc and table
_PATTERN, _REPEATED = 128, (1, 6)  # px of a pattern's side; times that it repeats along the table
_SHIFT, _TURN, _ROLL = 0.2, 10.0, 35.0  # m and degrees, of the front camera, at most
_NEAR = 0.03, 7.0  # m and degrees, of one that is taken to stand where it usually does
_LENS = 34.0, 64.0  # degrees, vertical field of view
_MARGIN = 0.05  # of the image, beside the table's corners that a camera must see


def draw_colour(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """Draw a colour, RGB in [0, 1]: half of all are nearly grey."""
    hue, saturation, value = rng.uniform(), rng.uniform() ** 2, rng.uniform(0.04, 1.0)
    hsv = np.array([[[360 * hue, saturation, value]]], np.float32)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0].astype(float)


def draw_pattern(rng: np.random.Generator) -> UInt8[np.ndarray, "p p 3"]:
    """Draw a pattern that mixes two colours: stripes, or grain of any size, drawn out along one side or not."""
    y, x = np.mgrid[:_PATTERN, :_PATTERN] / _PATTERN
    if rng.random() < 0.3:
        wave = np.sin(2 * np.pi * (rng.integers(1, 9) * x + rng.integers(0, 3) * y))
        share = 0.5 + 0.5 * np.clip(wave * rng.uniform(1, 8), -1, 1)
    else:
        blur = np.exp(rng.uniform(np.log(0.6), np.log(12.0), 2))
        grain = rng.normal(size=(_PATTERN, _PATTERN))
        grain = cv2.GaussianBlur(grain, (0, 0), *blur, borderType=cv2.BORDER_REFLECT)
        share = 1 / (1 + np.exp(-rng.uniform(0.5, 4) * grain / grain.std()))
    one, other = draw_colour(rng), draw_colour(rng)
    other = one + rng.uniform(0.1, 1) * (other - one)
    mixed = share[..., None] * one + (1 - share[..., None]) * other
    return (255 * mixed).astype(np.uint8)


def cover_table(spec: mujoco.MjSpec, rng: np.random.Generator) -> None:
    """Cover the table with a pattern."""
    pattern = draw_pattern(rng)
    texture = spec.add_texture(
        name="cover",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=_PATTERN,
        height=_PATTERN,
        nchannel=3,
    )
    texture.data = pattern.tobytes()
    repeated = rng.integers(*_REPEATED, 2, endpoint=True).tolist()
    material = spec.add_material(name="cover", texrepeat=repeated)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "cover"
    table = spec.geom("table")
    table.material = "cover"
    table.rgba[:] = 1


def paint(model: Any, rng: np.random.Generator) -> None:
    """Paint table (a pattern is tinted) and disc at random, and draw the disc's radius."""
    table, disc = draw_colour(rng), draw_colour(rng)
    while np.linalg.norm(table - disc) < _CONTRAST:
        table, disc = draw_colour(rng), draw_colour(rng)
    model.geom("table").rgba[:3] = table
    model.geom("goal").rgba[:3] = disc
    model.geom("goal").size[0] = rng.uniform(*_DISC)


def draw_near_placement(usual: CameraPlacement, rng: np.random.Generator) -> CameraPlacement:
    """Draw a camera 3 cm and 7 degrees (pitch, yaw) from another one, along each axis at most."""
    place = np.add(usual[:3], rng.uniform(-_NEAR[0], _NEAR[0], 3))
    return moved_camera(usual, place, (0.0, *rng.uniform(-_NEAR[1], _NEAR[1], 2)), usual[7])


def moved_camera(
    usual: CameraPlacement,
    place: Float[np.ndarray, "3"],
    turn: tuple[float, float, float],
    fovy: float,
) -> CameraPlacement:
    """Return a camera at a place (m), turned from the usual one by roll, pitch and yaw (degrees)."""
    facing = Rotation.from_quat(usual[3:7], scalar_first=True)
    turned = facing * Rotation.from_euler("zxy", turn, degrees=True)
    x, y, z = place.tolist()
    return (x, y, z, *turned.as_quat(scalar_first=True).tolist(), float(fovy))


def draw_placement(
    usual: CameraPlacement, table: tuple[tuple[float, float], ...], rng: np.random.Generator
) -> CameraPlacement:
    """Draw a camera that sees a part of the table, x and y from and to (m), from elsewhere."""
    corners = np.array([[x, y, z] for x in table[0] for y in table[1] for z in (0.0, 0.1)])
    while True:
        share = rng.uniform()  # so that small changes are among them
        place = np.add(usual[:3], share * rng.uniform(-_SHIFT, _SHIFT, 3))
        roll, pitch, yaw = share * rng.uniform(-1, 1, 3) * (_ROLL, _TURN, _TURN)
        fovy = usual[7] + share * (rng.uniform(*_LENS) - usual[7])
        camera = moved_camera(usual, place, (roll, pitch, yaw), fovy)
        seen = Rotation.from_quat(camera[3:7], scalar_first=True).inv().apply(corners - place)
        edge = (1 - _MARGIN) * np.tan(np.radians(fovy / 2))
        if np.all(np.abs(seen[:, :2]) < edge * seen[:, 2:]):
            return camera


def place_camera(camera: Any, placement: CameraPlacement) -> None:
    """Put a camera of an MjSpec or MjModel there."""
    *pos, w, x, y, z, fovy = placement
    camera.pos, camera.fovy = np.array(pos), fovy
    # Half a turn about x: MuJoCo's cameras look along -z and have y up.
    camera.quat = np.array([-x, w, z, -y])


def measured_placement(
    model: Any, data: Any, error: tuple[float, float], rng: np.random.Generator
) -> CameraPlacement:
    """Return where the front camera is, base frame, with an error (m and rad, RMS) of place and orientation."""
    camera = data.camera("front")
    place, turn = (rng.normal(0, rms / np.sqrt(3), 3) for rms in error)
    R = rotation_matrix(turn) @ camera.xmat.reshape(3, 3) @ np.diag([1, -1, -1])
    w, x, y, z = Rotation.from_matrix(R).as_quat(scalar_first=True)
    return (*(camera.xpos + place), w, x, y, z, float(model.camera("front").fovy[0]))
