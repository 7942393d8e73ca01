"""Changes of camera, light and objects: places of known points in the image, sizes, friction."""

from typing import Any

import numpy as np
import pytest

from benchmarks.deployment.first_look import changed_camera
from touchgoal.control.features import FRONT
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.scene.lighting import Lighting

SIZE = 256


def imaged(**options: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the front camera's image and the middle (column, row) of the goal's green disc in it."""
    config = PickPlaceConfig(tactile=False, cameras=("front",), camera_size=(SIZE, SIZE), **options)
    env = PickPlace(config)
    image = env.reset(seed=3)[0][FRONT].astype(int)
    env.close()
    green = image[..., 1] > 1.5 * image[..., 0]
    return image, np.argwhere(green).mean(0)[::-1]


def test_a_camera_turns_and_moves_as_said() -> None:
    """Turned to its right, the scene moves left by focal length times tangent; up, it moves down."""
    focal = SIZE / 2 / np.tan(np.radians(20))  # px, of 40 degrees
    _, usual = imaged()
    _, right = imaged(**changed_camera(turn=(0, 0, 5)))
    _, up = imaged(**changed_camera(turn=(0, 5, 0)))
    expected = focal * np.tan(np.radians(5))
    assert right - usual == pytest.approx([-expected, 0], abs=2)
    assert up - usual == pytest.approx([0, expected], abs=2)
    # It looks from the front, so that y to the left of the arm is right in its image.
    _, aside = imaged(**changed_camera((0, 0.02, 0)))
    distance = np.linalg.norm([1.15 - 0.46, 0.55])  # m, about that of the goal
    assert aside - usual == pytest.approx([-focal * 0.02 / distance, 0], abs=1)


def test_the_room_dims_and_the_lamp_moves() -> None:
    usual, _ = imaged()
    dim, _ = imaged(lighting=Lighting(room_light=-0.8))
    assert dim.mean() == pytest.approx(0.2 * usual.mean(), rel=0.1)
    lamp, _ = imaged(lighting=Lighting(lamp_shift=(-0.4, 0.0, 0.0)))
    assert 1 < np.abs(lamp - usual).mean() < 30


def test_objects_grow_lose_friction_and_are_moved_after_a_second() -> None:
    plain = PickPlaceConfig(tactile=False, cameras=())
    usual = PickPlace(plain)
    changed = PickPlace(plain, size_factor=1.2, friction_factor=0.5, nudge=0.02)
    for env in (usual, changed):
        env.reset(seed=1)
    body, other = usual.bodies[0], changed.bodies[0]
    assert other.size == pytest.approx(1.2 * np.array(body.size))
    geom = changed.model.geom("object")
    assert geom.friction[0] == pytest.approx(0.5 * usual.model.geom("object").friction[0])
    stay = np.append(np.zeros(changed.n_joints), 0.08)
    places = []
    for _ in range(changed.config.control_hz + 2):
        places.append(changed.object_pose()[:2])
        changed.step(stay)
    moves = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert moves[:-1].max() < 2e-4 and moves[-1] == pytest.approx(0.02, abs=2e-3)
    for seed in range(6):  # the hand is around it: two of its sides are fingers
        changed.reset(seed=seed, options={"object": "soda_can"})
        pose, changed._ticks = changed.data.joint("object").qpos, changed.config.control_hz
        pose[:3] = between = changed.data.site("tcp").xpos.copy()
        changed.begin_tick()
        changed.update_contacts()
        assert not changed.external_wrench().any()
        assert np.linalg.norm(pose[:2] - between[:2]) == pytest.approx(0.02)


def test_a_kept_opengl_context_draws_what_a_new_one_draws() -> None:
    """A pebble has a mesh of its own, which lies in the context; balls and bricks share one."""
    config = PickPlaceConfig(tactile=False, cameras=("front",), camera_size=(64, 64))
    kept = PickPlace(config)
    for seed, name in enumerate(("golf_ball", "pebble", "brick", "walnut", "golf_ball")):
        new, options = PickPlace(config), {"object": name}
        one, other = (e.reset(seed=seed, options=options)[0][FRONT] for e in (kept, new))
        np.testing.assert_array_equal(one, other)
        new.close()
    kept.close()
