"""Simulated tactile images: what they show, sensor by sensor; random surfaces and their encoder."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from numba import typeof

from touchgoal.control.tactile.sensor_calibration import shade
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI as MINI
from touchgoal.sim_envs.config import NO_RANDOMIZATION
from touchgoal.sim_envs.scene.objects import CATALOGUE, Body
from touchgoal.sim_envs.tactile.geometry import (
    BOX,
    CAPSULE,
    CYLINDER,
    SPHERE,
    Grid,
    add_mesh,
    add_primitive,
)
from touchgoal.sim_envs.tactile.optics import render
from touchgoal.sim_envs.tactile.pad import TactileFrame
from touchgoal.sim_envs.tactile.rig.press_bench import PressBench
from touchgoal.sim_envs.tactile.rig.surface_press import SurfacePose, overlap
from touchgoal.sim_envs.tactile.rig.surfaces import TILE, Surface
from touchgoal.sim_envs.tactile.sensor_instance import sample_instance

INSTANCE = sample_instance(MINI, np.random.default_rng(0), NO_RANDOMIZATION)


def rotation(axis: int, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    R = np.eye(3)
    a, b = [i for i in range(3) if i != axis]
    R[a, a], R[a, b], R[b, a], R[b, b] = c, -s, s, c
    return R


def inside(kind: int, p: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Whether points in the object's frame lie in the primitive."""
    if kind == SPHERE:
        return np.asarray(np.linalg.norm(p, axis=-1) <= size[0])
    if kind == BOX:
        return np.asarray((np.abs(p) <= size).all(axis=-1))
    side = np.linalg.norm(p[..., :2], axis=-1)
    if kind == CYLINDER:
        return (side <= size[0]) & (np.abs(p[..., 2]) <= size[1])
    beyond = np.maximum(np.abs(p[..., 2]) - size[1], 0)
    return side**2 + beyond**2 <= size[0] ** 2


def test_a_process_that_is_sent_a_sensor_runs_the_code_that_is_compiled() -> None:
    """Numba compiles again for a read-only array, and an arm would wait for it."""
    arrays = INSTANCE.background, INSTANCE.noise, INSTANCE.illumination
    sent = pickle.loads(pickle.dumps(arrays))
    assert [typeof(a) for a in sent] == [typeof(a) for a in arrays]


@pytest.mark.parametrize("kind", [BOX, CYLINDER, SPHERE, CAPSULE])
def test_rays_find_the_near_surface(kind: int) -> None:
    """Just beyond the surface a point lies in the object, just before it outside."""
    grid = Grid(30, 40, 0.5e-3)
    rng = np.random.default_rng(kind)
    y, x = np.mgrid[0:30, 0:40]
    for _ in range(5):
        R = rotation(0, rng.uniform(0, 3)) @ rotation(1, rng.uniform(0, 3))
        size = rng.uniform(0.004, 0.008, 3)
        position = np.array([*rng.uniform(-2e-3, 2e-3, 2), 0.01])
        height = grid.empty()
        add_primitive(height, grid.pitch, kind, position, R, size)
        hit = height > -0.9
        assert 0.05 < hit.mean() < 1
        points = np.stack([(x - 19.5) * grid.pitch, (y - 14.5) * grid.pitch, -height], -1)
        for step, expected in ((5e-6, True), (-5e-6, False)):
            local = (points + [0, 0, step] - position) @ R
            share = (inside(kind, local[hit], size) == expected).mean()
            assert share > 0.98  # rays that graze the rim may go either way


def test_scan_lines_find_what_rays_find() -> None:
    """A box as twelve triangles and as a primitive, however it is turned."""
    size = np.array([0.006, 0.004, 0.010])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size
    # Two triangles a face, counter-clockwise from outside; corner index = 4 x + 2 y + z.
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([[(a, b, c), (a, c, d)] for a, b, c, d in quads], np.int32).reshape(-1, 3)
    grid = Grid(120, 160, 0.118e-3)
    rng = np.random.default_rng(0)
    for _ in range(10):
        R = rotation(0, rng.uniform(0, 3)) @ rotation(1, rng.uniform(0, 3))
        position = np.array([*rng.uniform(-3e-3, 3e-3, 2), 0.01])
        rays, lines = grid.empty(), grid.empty()
        add_primitive(rays, grid.pitch, BOX, position, R, size)
        add_mesh(lines, grid.pitch, corners.astype(np.float32), faces, position, R)
        assert ((rays > -0.9) != (lines > -0.9)).mean() < 1e-3
        both = (rays > -0.9) & (lines > -0.9)
        difference = np.abs(rays - lines)[both]
        assert both.any() and (difference > 1e-7).mean() < 1e-3  # 0.1 um, but for the rim


def sense(body: Body, at: np.ndarray | list[float], force: float = 10.0) -> TactileFrame:
    """Press a body at `at` (m, sensor frame) on a nominal Mini."""
    bench = PressBench(body, MINI, INSTANCE)
    bench.place(np.asarray(at, float))
    return bench.sense(force, np.random.default_rng(1), centre=(float(at[0]), float(at[1])))


@pytest.mark.parametrize("force", [2.0, 15.0])
def test_ball_sinks_as_the_elastic_foundation_says(force: float) -> None:
    """Pressed volume pi R d^2 times the modulus is the force, so d = sqrt(F / (pi R k))."""
    radius, k = 0.02, MINI.foundation_modulus
    overlap = sense(
        Body(CATALOGUE["glass_ball"], (radius,), 0.1), at=[0, 0, 0.023], force=force
    ).overlap
    assert overlap.max() == pytest.approx(np.sqrt(force / (np.pi * radius * k)), rel=0.02)
    carried = k * overlap.sum() * (2 * MINI.pixel_pitch) ** 2
    assert carried == pytest.approx(force, rel=0.02)


def test_contact_appears_where_it_is() -> None:
    ball = Body(CATALOGUE["glass_ball"], (0.01,), 0.1)
    dx, dy = 3e-3, -2e-3
    frame = sense(ball, np.array([dx, dy, 0.009]), force=3.0)
    rows, columns = np.nonzero(frame.mask)
    assert columns.mean() == pytest.approx(159.5 + dx / MINI.pixel_pitch, abs=1)
    assert rows.mean() == pytest.approx(119.5 + dy / MINI.pixel_pitch, abs=1)
    # Each flank shines in the colour of the light that it faces.
    change = frame.image.astype(float) - INSTANCE.calibration.background
    y, x = np.mgrid[0:240, 0:320] - np.array([rows.mean(), columns.mean()]).reshape(2, 1, 1)
    for channel, (rx, ry) in enumerate(INSTANCE.calibration.response[:, :2, 0]):
        towards = (x * rx + y * ry) / np.hypot(rx, ry)
        near, far = frame.mask & (towards > 12), frame.mask & (towards < -12)
        assert change[near, channel].mean() > change[far, channel].mean() + 10


@pytest.mark.parametrize("kind", ["glass_ball", "golf_ball"])
@pytest.mark.parametrize("squares", [False, True])
def test_fast_image_is_the_reference_formula_s(squares: bool, kind: str) -> None:
    """Half the resolution under smooth bodies, and 1/16 count steps, against the reference."""
    frame = sense(Body(CATALOGUE[kind], (0.008,), 0.1), at=[4e-3, -3e-3, 0.007], force=6.0)
    assert len(frame.surface) == (240 if CATALOGUE[kind].material.is_textured else 120)
    calibration = INSTANCE.calibration
    if squares:
        falloff = calibration.response[..., :1] * np.float32([-0.9, 1.5])  # pyright: ignore[reportArgumentType]
        response = np.concatenate([calibration.response, falloff], 2)
        calibration = replace(calibration, response=response)
    noise = np.zeros_like(INSTANCE.noise)
    quiet = replace(INSTANCE, calibration=calibration, noise=noise)
    fast = render(frame.surface, quiet, np.random.default_rng(0)).astype(float)
    slow = np.clip(shade(calibration, frame.depth), 0, 255)
    assert np.abs(slow - INSTANCE.calibration.background).max() > 40
    error = np.abs(fast - slow)
    assert error.mean() < 0.6 and np.quantile(error, 0.999) < 6


def test_softer_objects_press_wider_and_shallower() -> None:
    at = np.array([0, 0, 0.019])
    hard = sense(Body(CATALOGUE["glass_ball"], (0.02,), 0.1), at)
    soft = sense(Body(CATALOGUE["foam_ball"], (0.02,), 0.1), at)
    assert soft.mask.sum() > 1.3 * hard.mask.sum() and soft.depth.max() < 0.8 * hard.depth.max()


@pytest.mark.parametrize("at", [[0.0125, 0, 0.01], [0.03, 0, 0.01], [0, 0, -0.02], [0, 0, 0.03]])
@pytest.mark.parametrize("half", [0.0004, 0.01, 0.05])  # m: smaller and larger than the gel
def test_degenerate_contacts_stay_finite(at: list[float], half: float) -> None:
    """At the gel's edge, beside it, far too deep, out of reach, pressed beyond any gripper."""
    for force in (1e-3, 500.0):
        frame = sense(Body(CATALOGUE["brick"], (half, half, half), 0.1), at, force)
        assert np.isfinite(frame.depth).all() and frame.depth.min() > -1e-4
        assert frame.field is not None and np.isfinite(frame.field.wrench()).all()


SMOOTH = np.zeros((TILE, TILE), np.float32)
LEVEL = SurfacePose((0.0, 0.0), 0.0, (0.0, 0.0), (128.0, 128.0), 0.5e-3)
SHAPE, PITCH = (120, 160), 0.118e-3


def test_a_ball_lies_in_the_gel_as_deep_as_it_is_pressed() -> None:
    """Against the circle of a sphere: at its rim the overlap of radius a is a^2 / 2R less."""
    ball = Surface("ball", 5e-3, 1.0, SMOOTH, 1.0)
    deep = overlap(ball, LEVEL, SHAPE, PITCH)
    assert deep.max() == pytest.approx(0.5e-3, abs=3e-5)
    rim = np.sqrt((deep > 0).sum() * PITCH**2 / np.pi)
    assert rim == pytest.approx(np.sqrt(2 * 5e-3 * 0.5e-3), rel=0.02)
    soft = overlap(replace(ball, firmness=0.5), LEVEL, SHAPE, PITCH)
    np.testing.assert_allclose(soft, deep / 2, atol=1e-9)
