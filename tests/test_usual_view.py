"""A calibrated camera's image as the training's camera sees it, with MuJoCo's renderer as the oracle."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.deployment import first_look as first_look_benchmark
from benchmarks.deployment.first_look import Config
from touchgoal.control import features as ft
from touchgoal.policies.checkpoint import ESTIMATOR, SHIPPED_POLICIES
from touchgoal.policies.perception.state_estimation import StateEstimator, load_pose_estimator
from touchgoal.policies.perception.usual_view import UsualView
from touchgoal.runtime.errors import RefusedError, UserError
from touchgoal.sim_envs.config import USUAL_CAMERA, CameraPlacement, PickPlaceConfig
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.scene.variety import moved_camera

TASK = PickPlaceConfig(
    objects=("wooden_block",), tactile=False, cameras=("front",), camera_size=(256, 256)
)


def placed(shift: tuple[float, float, float], roll: float, fovy: float) -> CameraPlacement:
    return moved_camera(USUAL_CAMERA, np.add(USUAL_CAMERA[:3], shift), (roll, 0, 0), fovy)


def first_look(camera: CameraPlacement | None) -> tuple[PickPlace, dict[str, np.ndarray]]:
    env = PickPlace(replace(TASK, front_camera=camera))
    observation, _ = env.reset(seed=8)
    return env, {**observation, **dict.fromkeys(ft.TACTILE, np.zeros((8, 8, 3), np.uint8))}


def test_another_orientation_and_lens_show_what_the_usual_camera_shows() -> None:
    camera = placed((0, 0, 0), roll=20, fovy=60)
    (_, seen), (env, usual) = first_look(camera), first_look(None)
    np.testing.assert_allclose(env.calibrated_camera(), USUAL_CAMERA)
    at = env.data.camera("front")
    np.testing.assert_allclose(at.xpos, USUAL_CAMERA[:3])
    R = Rotation.from_quat(USUAL_CAMERA[3:7], scalar_first=True).as_matrix()
    np.testing.assert_allclose(R @ np.diag([1, -1, -1]), at.xmat.reshape(3, 3), atol=1e-5)
    view = UsualView(USUAL_CAMERA, camera, (256, 256))
    off = np.abs(view(seen[ft.FRONT]).astype(float) - usual[ft.FRONT])
    plain = np.abs(seen[ft.FRONT].astype(float) - usual[ft.FRONT])
    assert np.median(off) <= 2 < plain.mean() / 4 and off.mean() < plain.mean() / 4


@pytest.mark.parametrize(
    ("camera", "allowed"),
    [(placed((0, 0, 0), 30, 40), 0.01), (placed((0, 0.15, 0), 0, 55), 0.02), (placed((0.17, 0, 0.1), 0, 50), 0.02)],
)  # fmt: skip
def test_a_calibrated_camera_that_stands_elsewhere_finds_object_and_disc(
    camera: CameraPlacement, allowed: float
) -> None:
    network = load_pose_estimator(SHIPPED_POLICIES["pick-place"] / ESTIMATOR)
    env, first = first_look(camera)
    true = env.start_of("object")
    found = StateEstimator(network, "", env.calibrated_camera()).estimate(first, first)[
        ft.TRUTH_START
    ]
    assert (
        np.linalg.norm((found - true)[:2]) < allowed
        and np.linalg.norm((found - true)[5:]) < allowed
    )
    blind = StateEstimator(network)  # which takes the camera to stand as in training
    try:
        off = blind.estimate(first, first)[ft.TRUTH_START] - true
    except RefusedError:
        return
    assert np.linalg.norm(off[:2]) > 0.01


def test_benchmark_first_look(capsys: pytest.CaptureFixture) -> None:
    changes = ["unchanged", "lens of 60 degrees", "blue table", "two others, no name"]
    found = first_look_benchmark.run(Config(changes=tuple(changes), looks=2, workers=1))["rows"]
    assert [row["right"] for row in found] == [2, 2, 2, 0]
    assert [row["refused"] for row in found] == [0, 0, 0, 2]
    with pytest.raises(UserError, match="no change 'tablecloth'"):
        first_look_benchmark.run(Config(changes=("tablecloth",)))


def test_a_camera_that_is_not_where_it_was_calibrated_is_told() -> None:
    network = load_pose_estimator(SHIPPED_POLICIES["pick-place"] / ESTIMATOR)
    _, first = first_look(moved_camera(USUAL_CAMERA, np.array(USUAL_CAMERA[:3]), (0, 6, 0), 40))
    with pytest.raises(RefusedError, match="mm from where the calibrated camera sees them"):
        StateEstimator(network, "", USUAL_CAMERA).estimate(first, first)
    aside = placed((0, 0.1, 0), 0, 40)
    view, image = UsualView(USUAL_CAMERA, aside, (256, 256)), first[ft.FRONT]
    shown = [view.shows(np.array([150.0, column]), image) for column in (6.0, 128.0, 250.0)]
    assert shown == [False, True, True]
    shifted = PickPlace(replace(TASK, front_camera=placed((0, 0.02, 0), 0, 40), as_deployed=True))
    shifted.reset(seed=3)
    off = np.subtract(shifted.calibrated_camera()[:3], USUAL_CAMERA[:3])
    shifted.reset(seed=3)
    assert (off == np.subtract(shifted.calibrated_camera()[:3], USUAL_CAMERA[:3])).all()
    assert 0 < np.linalg.norm(off - (0, 0.02, 0)) < 0.02
