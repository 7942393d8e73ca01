"""Hand-eye calibration by a board in the simulated cell; MuJoCo knows where its cameras are."""

import json
import shutil
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
import pytest
from board_scene import BOARD, BoardScene, add_board, postures
from PIL import Image

from touchgoal.control.cell.cell_file import EXAMPLES, cell_table, read_cell_file, write_camera
from touchgoal.control.hand_eye.board import BoardView
from touchgoal.control.hand_eye.solve import HandEye, View, calibrate_camera, calibrate_hand_eye
from touchgoal.control.motion.rotations import fingers_down, rotation_matrix, rotation_vector
from touchgoal.control.safety.limits import FR3
from touchgoal.launch.__main__ import main
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell import hardware
from touchgoal.sim_envs.scene.build import build
from touchgoal.sim_envs.twin.cell_task import env_config_of

VALUES = {"pose": [1.1, 0.02, 0.5, 0.1, 0.7, -0.7, 0.1], "fovy": 41.5}


# Where the simulated cell has its cameras (in the hand, in the base), by OpenCV's axes, and their fovy.
CAMERAS = {
    "wrist": ([[0, -0.922, -0.387], [1, 0, 0], [0, -0.387, 0.922]], [0.075, 0.0, 0.02], 62),
    "front": ([[0, 0.546, -0.838], [1, 0, 0], [0, -0.838, -0.546]], [1.15, 0.0, 0.55], 40),
}
SQUARES = np.array([[0.025 * i, 0.025 * j, 0.0] for j in range(1, 6) for i in range(1, 8)])


def pose(R: Any, p: Any) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T


def error_of(true: np.ndarray, found: np.ndarray) -> tuple[float, float]:
    """Distance (mm) and turn (degrees) between two poses."""
    D = np.linalg.inv(true) @ found
    turn = np.linalg.norm(rotation_vector(D[:3, :3]))
    return 1e3 * float(np.linalg.norm(D[:3, 3])), float(np.degrees(turn))


def drawn_views(
    camera: str, seed: int, arm_off: float = 1.0, square: float = 1.0
) -> tuple[list[BoardView], list[np.ndarray], np.ndarray]:
    """15 views projected by OpenCV with 0.1 px of noise, the hand's poses as the arm tells, the truth.

    On each axis the arm is off by 0.1 degrees and 0.5 mm a view, times `arm_off`; the board is
    printed at `square` times its size.
    """
    rng, on_hand = np.random.default_rng(seed), camera == "wrist"
    R, p, fovy = CAMERAS[camera]
    U, _, Vt = np.linalg.svd(R)
    X, focal = pose(U @ Vt, p), 240 / np.tan(np.radians(fovy / 2))
    K = np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1]])
    corners = square * (SQUARES - [0.1, 0.075, 0.0])
    board = pose([[0, 0, -1], [1, 0, 0], [0, -1, 0]], [0, 0, 0.16])
    middle, room = [0.55, 0.0, 0.32], [0.18, 0.15, 0.15]
    if on_hand:
        board, middle, room = pose(np.diag([1, -1, -1]), [0.45, 0, 0.004]), [0.4, 0, 0.25], 0.1
    views, hands = [], []
    while len(views) < 15:
        R = rotation_matrix(rng.uniform(-0.45, 0.45, 3)) @ fingers_down(0.0)
        hand = pose(R, middle + rng.uniform(-1, 1, 3) * room - FR3.tool.tcp_offset * R[:, 2])
        seen = np.linalg.inv(X) @ (np.linalg.inv(hand) if on_hand else hand) @ board
        turn, shift = cv2.Rodrigues(seen[:3, :3])[0], seen[:3, 3]
        pixels = cv2.projectPoints(corners, turn, shift, K, np.zeros(5))[0].reshape(-1, 2)
        inside = ((pixels > 5) & (pixels < [635, 475])).all(axis=1)
        if seen[2, 2] > 0.2 and inside.sum() > 15:  # not from behind or flat, and not cut off
            noisy = pixels[inside] + rng.normal(0, 0.1, (inside.sum(), 2))
            off = np.radians(0.1) * rng.normal(size=3), 5e-4 * rng.normal(size=3)
            views.append(BoardView(SQUARES[inside], noisy))
            hands.append(hand @ pose(rotation_matrix(arm_off * off[0]), arm_off * off[1]))
    return views, hands, X


def solved(camera: str, views: list[BoardView], hands: list[np.ndarray]) -> HandEye:
    return calibrate_hand_eye(views, hands, (640, 480), camera == "wrist")


@pytest.mark.parametrize("arm_off", [1.0, 3.0])
@pytest.mark.parametrize("camera", CAMERAS)
def test_the_error_is_the_printed_one_whatever_the_arms(camera: str, arm_off: float) -> None:
    """The lens takes up none of the arm's error; better than the closed form by itself."""
    errors, printed, closed = [], [], []
    for seed in range(8):
        views, hands, X = drawn_views(camera, seed, arm_off)
        result = solved(camera, views, hands)
        assert result.arm_noise == pytest.approx(5e-4 * arm_off, rel=0.3)
        errors.append([*error_of(X, result.pose), 100 * (result.square_scale - 1)])
        spread = result.position_error, result.rotation_error, result.square_scale_error
        printed.append(spread * np.array([1e3, 180 / np.pi, 100]))
        closed.append(error_of(X, result.closed_form)[0])
        # A view left out is off by its own error (0.9 mm along three axes) and the result's.
        assert 0.5 < 1e3 * result.position_errors.mean() / arm_off < 2.0
    rms, told, by_closed_form = (np.mean(np.square(v), 0) ** 0.5 for v in (errors, printed, closed))
    assert rms[0] < 2.0 * arm_off
    assert ((rms / told > 0.4) & (rms / told < 1.5)).all(), rms / told
    assert rms[0] < by_closed_form or arm_off > 1


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_board_printed_too_small_is_refused_and_measured(camera: str) -> None:
    views, hands, X = drawn_views(camera, 0, arm_off=0.0, square=0.97)
    with pytest.raises(UserError, match=r"show squares of 0\.97\d times .* correct --square-mm"):
        solved(camera, views, hands)
    measured = [BoardView(0.97 * view.points, view.pixels) for view in views]
    assert solved(camera, measured, hands).square_scale == pytest.approx(1, abs=5e-4)
    views, hands, X = drawn_views(camera, 0, arm_off=0.0, square=0.995)
    result = solved(camera, views, hands)
    assert result.square_scale == pytest.approx(0.995, abs=5e-4)
    assert error_of(X, result.pose)[0] < 1.0  # the misprint costs nothing


def test_a_view_that_contradicts_the_others_is_named() -> None:
    views, hands, _ = drawn_views("wrist", 0)
    hands[4] = hands[4] @ pose(np.eye(3), [0.0, 0.02, 0.0])
    with pytest.raises(UserError, match=r"view 5 is 2\d mm from where the others place the board"):
        solved("wrist", views, hands)


@pytest.mark.parametrize("old", [False, True])
def test_boards_of_both_patterns_are_found(old: bool) -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((8, 6), 0.025, 0.75 * 0.025, dictionary)
    board.setLegacyPattern(old)
    page = np.pad(board.generateImage((480, 360)), 60, constant_values=255)
    view = BOARD.find(np.repeat(page[..., None], 3, axis=2))
    assert view is not None and view.old_pattern is old and len(view.points) == 35
    np.testing.assert_allclose(view.pixels, 60 + view.points[:, :2] / 0.025 * 60, atol=1.0)


def views(scene: BoardScene, joints: list[np.ndarray]) -> list[View]:
    images = [scene.image(q) for q in joints]
    return [View(image, q, BOARD.find(image)) for image, q in zip(images, joints, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["wrist", "front"])
def test_a_camera_is_found_within_a_millimetre(camera: str) -> None:
    with closing(BoardScene(camera, 480, 640)) as scene:
        seen = views(scene, postures(scene, 16, seed=0))
        result = calibrate_camera(seen, FR3.arm, scene.on_hand)
        mm, turn = error_of(scene.true_pose(), result.pose)
        fovy = {"wrist": 62, "front": 40}[camera]
        focal = 240 / np.tan(np.radians(fovy / 2))
    assert mm < 1.0 and turn < 0.2, (mm, turn)
    assert abs(result.lens.fy / focal - 1) < 0.003 and abs(result.lens.k1) < 0.02
    assert 1e3 * result.position_errors.mean() < 1.0 and result.pixel_error < 0.3
    assert mm < 5e3 * result.position_error  # the standard error is no boast


def test_views_that_do_not_fix_a_camera_are_refused() -> None:
    with closing(BoardScene("wrist", 480, 640)) as scene:
        [q] = postures(scene, 1, seed=0)
        about_one_axis = [q + turn * np.eye(7)[6] for turn in np.linspace(-0.3, 0.3, 8)]
        seen = views(scene, about_one_axis)
    with pytest.raises(UserError, match="do not fix the camera: turn .* about two axes"):
        calibrate_camera(seen, FR3.arm, on_hand=True)
    with pytest.raises(UserError, match="3 views show the board, 6 are needed"):
        calibrate_camera(seen[:3], FR3.arm, on_hand=True)


@pytest.mark.slow
def test_the_command_moves_the_arm_and_writes_the_cell_file(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def with_board(*args: Any) -> mujoco.MjSpec:
        spec = build(*args)
        add_board(spec, held=False)
        return spec

    monkeypatch.setattr(hardware, "build", with_board)
    monkeypatch.setattr("touchgoal.sim_envs.cell.in_process.STREAM_SIZE", (480, 640))
    monkeypatch.setattr("time.sleep", lambda _: None)  # simulated time need not keep pace
    cell_file = tmp_path / "cell.toml"
    shutil.copy(EXAMPLES / "sim.toml", cell_file)
    with closing(BoardScene("wrist", 480, 640)) as scene:
        poses = [q.tolist() for q in postures(scene, 6, seed=1)]
        truth = scene.true_pose()
    (tmp_path / "poses.json").write_text(json.dumps(poses))
    words = [str(cell_file), "--camera", "wrist", "--poses", str(tmp_path / "poses.json"), "--yes"]
    main(["calibrate-camera", *words, "--out", str(tmp_path / "run")])
    printed = capsys.readouterr().out
    assert "left out, each of 6 views is missed by" in printed and "written to" in printed
    assert "squares of the board: 2" in printed and "25 mm given" in printed
    camera = read_cell_file(cell_file).cameras["wrist"]
    assert camera.pose is not None and camera.fovy == pytest.approx(62, abs=0.3)
    np.testing.assert_allclose(camera.pose[:3], truth[:3, 3], atol=1e-3)
    assert len(json.loads((tmp_path / "run" / "joints.json").read_text())) == 6


def test_the_board_prints_at_true_scale(tmp_path: Path) -> None:
    main(["calibrate-camera", "--board", str(tmp_path / "board.png"), "--square-mm", "20"])
    with Image.open(tmp_path / "board.png") as image:
        dark = np.flatnonzero((np.asarray(image)[:400] < 128).any(axis=0))
        width = 25.4 * (dark[-1] - dark[0] + 1) / image.info["dpi"][0]
        view = BOARD.find(np.asarray(image.convert("RGB")))
    assert width == pytest.approx(160, abs=0.2) and view is not None and len(view.points) == 35


@pytest.mark.parametrize("name", ["fr3_two_minis.toml", "cell.json"])
def test_the_pose_is_written_into_the_cell_file_and_nothing_else(name: str, tmp_path: Path) -> None:
    path, example = tmp_path / name, EXAMPLES / "fr3_two_minis.toml"
    before = read_cell_file(example)
    if path.suffix == ".json":
        path.write_text(json.dumps(cell_table(before)))
    else:
        shutil.copy(example, path)
    for values in ({"pose": [0.0] * 6 + [1.0], "fovy": 1.0}, VALUES):
        write_camera(path, "front", values)
    after = read_cell_file(path)
    camera = after.cameras["front"]
    assert camera.pose == tuple(VALUES["pose"]) and camera.fovy == 41.5
    assert camera.source == "/dev/video0" and after.task == before.task
    if path.suffix == ".toml":
        lines = path.read_text().splitlines()
        assert [line for line in lines if not line.startswith(("pose =", "fovy ="))] == (
            example.read_text().splitlines()
        )


def test_a_file_that_cannot_be_edited_prints_the_lines(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    text = 'cameras.front = { source = "0" }\n'
    path.write_text(text)
    with pytest.raises(UserError, match=r"put these lines under \[cameras.front\]:\npose = "):
        write_camera(path, "front", VALUES)
    assert path.read_text() == text


def test_a_simulated_arm_has_its_camera_where_the_cell_file_says(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    shutil.copy(EXAMPLES / "sim.toml", path)
    write_camera(path, "front", VALUES)
    model = build([], env_config_of(read_cell_file(path))).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera, R = data.camera("front"), np.zeros(9)
    mujoco.mju_quat2Mat(R, np.array(VALUES["pose"][3:]))
    np.testing.assert_allclose(camera.xpos, VALUES["pose"][:3])
    ours = camera.xmat.reshape(3, 3) @ np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(ours, R.reshape(3, 3), atol=1e-9)
    assert model.cam_fovy[model.camera("front").id] == 41.5
    write_camera(path, "front", {"pose": [1.0] * 7})
    with pytest.raises(UserError, match="cameras.front.pose must end with a unit quaternion"):
        read_cell_file(path)
