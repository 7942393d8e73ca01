"""Hand-eye calibration by a board in the simulated cell; MuJoCo knows where its cameras are."""

import json
import shutil
from contextlib import closing
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from board_scene import BOARD, BoardScene, add_board, postures
from PIL import Image

from touchgoal.control.cell.camera_pose import write_camera
from touchgoal.control.cell.cell_file import EXAMPLES, cell_table, read_cell_file
from touchgoal.control.hand_eye.record import View, calibrate_camera
from touchgoal.control.motion.rotations import rotation_vector
from touchgoal.control.safety.limits import FR3
from touchgoal.launch.__main__ import main
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell import hardware
from touchgoal.sim_envs.scene.build import build
from touchgoal.sim_envs.twin.cell_task import env_config_of

VALUES = {"pose": [1.1, 0.02, 0.5, 0.1, 0.7, -0.7, 0.1], "fovy": 41.5}


def views(scene: BoardScene, joints: list[np.ndarray]) -> list[View]:
    pictures = [scene.picture(q) for q in joints]
    return [View(image, q, BOARD.find(image)) for image, q in zip(pictures, joints, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["wrist", "front"])
def test_a_camera_is_found_within_a_millimetre(camera: str) -> None:
    with closing(BoardScene(camera, 480, 640)) as scene:
        seen = views(scene, postures(scene, 16, seed=0))
        result = calibrate_camera(seen, FR3.arm, scene.on_hand)
        D = np.linalg.inv(scene.true_pose()) @ result.pose
        mm, turn = 1e3 * np.linalg.norm(D[:3, 3]), np.linalg.norm(rotation_vector(D[:3, :3]))
        fovy = {"wrist": 62, "front": 40}[camera]
        focal = 240 / np.tan(np.radians(fovy / 2))
    assert mm < 1.0 and np.degrees(turn) < 0.2, (mm, turn)
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
    assert "residuals of 6 views" in printed and "written to" in printed
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
