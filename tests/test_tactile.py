"""The simulated sensor: elastic-foundation laws, geometry against geometry, determinism."""

import numpy as np
import pytest

from touchgoal.control.sensors import GELSIGHT_MINI as MINI
from touchgoal.sim_envs.contact import PadContact
from touchgoal.sim_envs.experts import PickPlaceExpert
from touchgoal.sim_envs.objects import CATALOGUE, Body
from touchgoal.sim_envs.pick_place import PickPlace, PickPlaceConfig
from touchgoal.sim_envs.scene import build
from touchgoal.sim_envs.tactile.pad import TactilePad
from touchgoal.sim_envs.tactile.geometry import (
    BOX,
    CAPSULE,
    CYLINDER,
    SPHERE,
    Grid,
    primitive_height,
    settle,
)
from touchgoal.sim_envs.tactile.optics import sample_unit

GRID = Grid(*MINI.image_shape, MINI.pixel_pitch)


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
        height = primitive_height(grid, kind, position, R, size)
        hit = height > -0.9
        assert 0.05 < hit.mean() < 1
        points = np.stack([(x - 19.5) * grid.pitch, (y - 14.5) * grid.pitch, -height], -1)
        for step, expected in ((5e-6, True), (-5e-6, False)):
            local = (points + [0, 0, step] - position) @ R
            share = (inside(kind, local[hit], size) == expected).mean()
            assert share > 0.98  # rays that graze the rim may go either way


@pytest.mark.parametrize("force", [2.0, 15.0])
def test_ball_sinks_as_the_elastic_foundation_says(force: float) -> None:
    """Pressed volume pi R d^2 times the modulus is the force, so d = sqrt(F / (pi R k))."""
    radius, k = 0.02, MINI.foundation_modulus
    position = np.array([0, 0, radius + 0.003])
    height = primitive_height(GRID, SPHERE, position, np.eye(3), np.full(3, radius))
    shift = settle(height, GRID.pitch, force, k)
    depth = height.max() + shift
    assert depth == pytest.approx(np.sqrt(force / (np.pi * radius * k)), rel=0.03)
    carried = k * np.maximum(height + shift, 0).sum() * GRID.pitch**2
    assert carried == pytest.approx(force, rel=0.01)


def sense(body: Body, at: np.ndarray, force: float = 10.0):
    """What the left sensor shows of a body held at `at` (m) in its frame."""
    model = build([body]).compile()
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    site = data.site("left_sensor")
    R = site.xmat.reshape(3, 3)
    data.joint(body.name).qpos[:3] = site.xpos + R @ at
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, R.ravel())
    data.joint(body.name).qpos[3:] = quat
    mujoco.mj_forward(model, data)
    unit = sample_unit(MINI.image_shape, np.random.default_rng(0))
    pad = TactilePad(model, "left", MINI, unit, [body])
    contact = PadContact(
        np.array([0, 0, -force]), np.zeros(3), 0.0, frozenset({model.geom(body.name).id})
    )
    frame = pad.sense(data, contact, np.random.default_rng(1))
    pad.close()
    return frame


def test_mesh_feels_like_the_primitive_it_copies() -> None:
    size = (0.006, 0.004, 0.010)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size
    stone = next(k for k in CATALOGUE.values() if k.name == "pebble")
    block = Body(type(stone)("block", "box", stone.material, ()), size, 0.1)
    hull = Body(stone, (1.0,), 0.1, hull=corners)
    at = np.array([1e-3, -0.5e-3, 0.0095])
    one, other = sense(block, at), sense(hull, at)
    inner = one.mask & other.mask
    assert inner.sum() > 0.97 * one.mask.sum()
    assert np.abs(one.depth - other.depth)[inner].mean() < 5e-6


def test_contact_appears_where_it_is() -> None:
    ball = Body(CATALOGUE["glass_ball"], (0.01,), 0.1)
    dx, dy = 3e-3, -2e-3
    frame = sense(ball, np.array([dx, dy, 0.009]), force=3.0)
    rows, columns = np.nonzero(frame.mask)
    assert columns.mean() == pytest.approx(159.5 + dx / MINI.pixel_pitch, abs=1)
    assert rows.mean() == pytest.approx(119.5 + dy / MINI.pixel_pitch, abs=1)
    # The red light stands below the image: it brightens the lower flank, blue the upper one.
    unit = sample_unit(MINI.image_shape, np.random.default_rng(0))
    change = frame.image.astype(float) - np.moveaxis(unit.background, 0, -1)
    top = frame.mask & (np.arange(240)[:, None] < rows.mean() - 15)
    bottom = frame.mask & (np.arange(240)[:, None] > rows.mean() + 15)
    assert change[bottom, 0].mean() > 3 > -3 > change[top, 0].mean()
    assert change[top, 2].mean() > 3 > -3 > change[bottom, 2].mean()


def test_softer_things_press_wider_and_shallower() -> None:
    at = np.array([0, 0, 0.019])
    hard = sense(Body(CATALOGUE["glass_ball"], (0.02,), 0.1), at)
    soft = sense(Body(CATALOGUE["foam_ball"], (0.02,), 0.1), at)
    assert soft.mask.sum() > 1.3 * hard.mask.sum() and soft.depth.max() < 0.8 * hard.depth.max()


@pytest.mark.parametrize("at", [[0.0125, 0, 0.01], [0.03, 0, 0.01], [0, 0, -0.02]])
@pytest.mark.parametrize("force", [1e-3, 500.0])
def test_degenerate_contacts_stay_finite(at: list[float], force: float) -> None:
    frame = sense(Body(CATALOGUE["brick"], (0.01, 0.01, 0.01), 0.1), np.array(at), force)
    assert np.isfinite(frame.depth).all() and frame.depth.min() > -1e-4


def test_untouched_sensor_shows_only_noise() -> None:
    env = PickPlace(PickPlaceConfig(cameras=()))
    env.reset(seed=0)
    frames = [env.step(np.append(np.zeros(7), 0.08))[0] for _ in range(3)]
    images = np.stack([f["observation.images.tactile_left"] for f in frames]).astype(float)
    assert 0.3 < (images[1] - images[0]).std() / np.sqrt(2) < 1.5  # counts
    assert not env.tactile_frames()[0].mask.any()
    env.close()


def test_grasp_shows_on_both_pads_with_the_commanded_force() -> None:
    env = PickPlace(PickPlaceConfig(cameras=()))
    env.reset(seed=0, options={"object": "golf_ball", "grasp_force": 10.0})
    expert = PickPlaceExpert(env)
    for _ in range(60):
        env.step(expert.act({}))
    for frame in env.tactile_frames():
        assert frame.mask.mean() > 0.05
        pressed = MINI.foundation_modulus * frame.depth[frame.mask].sum() * MINI.pixel_pitch**2
        assert pressed == pytest.approx(10.0, rel=0.25)  # the gel's smoothing moves some outside
    env.close()
