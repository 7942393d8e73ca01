"""Demonstrations of a task of one's own: devices, recording, training, deployment, by no simulator's truth."""

import json
import os
import select
import socket
import struct
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from fake_cell import write_cell_file
from in_process import run
from scipy.spatial.transform import Rotation

from touchgoal.control import features as ft
from touchgoal.control.deployment.scripted import PickPlacePoses
from touchgoal.control.interfaces import DriverError
from touchgoal.control.motion.rotations import fingers_down, rotation_matrix, rotation_vector
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.limits import FR3
from touchgoal.control.teleoperation.device import HandMotion, KeyboardDevice, TeleoperationDevice
from touchgoal.control.teleoperation.scripted_device import ScriptedDevice
from touchgoal.control.teleoperation.spacemouse import SpaceMouse, find_spacemouse
from touchgoal.control.teleoperation.teleoperator import Teleoperator, YieldingHand
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch import record_demos
from touchgoal.launch.deploy import NOT_DONE
from touchgoal.launch.support import cell_run
from touchgoal.runtime.errors import UserError

OBSERVED: dict = {}
HZ, TICK = 20.0, 0.05
# The published table of reports (PySpaceMouse, devices.toml): axis -> report, first byte.
WIRED = {"x": (1, 1), "y": (1, 3), "z": (1, 5), "rx": (2, 1), "ry": (2, 3), "rz": (2, 5)}
WIRELESS = {"x": (1, 1), "y": (1, 3), "z": (1, 5), "rx": (1, 7), "ry": (1, 9), "rz": (1, 11)}
# And its convention with z up: x right, y away from the user, z up; rotations about them.
Z_UP = {"x": (0, 1), "y": (1, -1), "z": (2, -1), "rx": (3, 1), "ry": (4, -1), "rz": (5, -1)}


def plug_in(folder: Path, product: str) -> tuple[Path, Path]:
    """A made-up /sys and /dev with a mouse of another maker and a SpaceMouse."""
    for name, identity in (("hidraw0", "0003:0000046D:0000C077"), ("hidraw1", product)):
        node = folder / "sys" / name / "device"
        node.mkdir(parents=True)
        (node / "uevent").write_text(f"DRIVER=hid-generic\nHID_ID={identity}\nHID_NAME=x\n")
    (folder / "dev").mkdir()
    os.mkfifo(folder / "dev" / "hidraw1")
    return folder / "sys", folder / "dev"


@pytest.mark.parametrize(
    ("product", "table", "length"),
    [("0003:0000256F:0000C635", WIRED, 7), ("0003:0000256F:0000C62E", WIRELESS, 13),
     ("0003:0000046D:0000C626", WIRED, 7)],
)  # fmt: skip
def test_a_spacemouse_is_read_as_its_reports_are_documented(
    product: str, table: dict, length: int, tmp_path: Path
) -> None:
    with closing(SpaceMouse(*plug_in(tmp_path, product))) as mouse:
        assert not mouse.read(OBSERVED).twist.any()
        for axis, (report, first) in table.items():
            for count, share in ((350, 1.0), (-175, -0.5), (1000, 1.0), (10, 0.0)):
                content = bytearray(length)
                content[0] = report
                content[first : first + 2] = struct.pack("<h", count)
                for other in {1, 2} - {report}:
                    mouse.take(bytes([other, *bytes(length - 1)]))
                mouse.take(bytes(content))
                mouse._heard = np.inf
                index, sign = Z_UP[axis]
                right, away, up = sign * share * np.eye(6)[index].reshape(2, 3).T
                # Base: x away from the robot and its operator, y left, z up.
                expected = np.stack([away, -right, up], 1).ravel()
                np.testing.assert_allclose(mouse.read(OBSERVED).twist, expected)
        mouse.take(bytes([3, 1, 0]))
        assert mouse.read(OBSERVED).gripper == "close"
        mouse.take(bytes([3, 0, 0]))  # let go of: the hand stays closed
        assert mouse.read(OBSERVED).gripper == "close"
        mouse.take(bytes([3, 2, 0]))
        assert mouse.read(OBSERVED).gripper == "open"


def test_a_silent_spacemouse_is_at_rest_and_an_unplugged_one_is_said(tmp_path: Path) -> None:
    mouse = SpaceMouse(*plug_in(tmp_path, "0003:0000256F:0000C635"))
    ours, device = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)  # a report a read
    os.close(mouse._file)
    device.setblocking(False)
    mouse._file = device.detach()
    for z in (100, -350):
        ours.send(struct.pack("<B3h", 1, 0, 0, z))
    newest = mouse.read(OBSERVED).twist  # the cap is lifted
    assert newest.tolist() == [0, 0, 1, 0, 0, 0]
    mouse._heard -= 1.0
    assert not mouse.read(OBSERVED).twist.any()
    mouse.close()
    with pytest.raises(DriverError, match="plug it in"):
        mouse.read(OBSERVED)
    with pytest.raises(UserError, match="no SpaceMouse is plugged in"):
        find_spacemouse(tmp_path / "none")


def test_keys_are_held_for_a_moment_and_end_their_opposites() -> None:
    keyboard = KeyboardDevice(HZ)
    keyboard.press("wrx\x1b[A")  # the last ones mean nothing
    assert keyboard.read(OBSERVED).twist.tolist() == [1, 0, 1, 0, 0, 0]
    keyboard.press("sjg")
    motion = keyboard.read(OBSERVED)
    assert motion.twist.tolist() == [-1, 0, 1, 0, 0, 1] and motion.gripper == "close"
    for _ in range(10):
        motion = keyboard.read(OBSERVED)
    assert not motion.twist.any() and motion.gripper == "close"


class Pushed(TeleoperationDevice):
    """A device that asks for one motion for ever, and then says that it is done."""

    def __init__(self, twist: list[float], ticks: float = np.inf) -> None:
        self.twist, self.ticks = np.array(twist, float), ticks

    def read(self, observation: dict) -> HandMotion:
        self.ticks -= 1
        self.verdict = "" if self.ticks > 0 else "done"
        return HandMotion(self.twist, "close")


def act(twist: list[float], wrench: tuple[float, ...] = (0.0,) * 6) -> tuple[np.ndarray, ...]:
    """What an action moves (m) and turns (rad, base frame), and the gripper's width."""
    config = record_demos.TeleoperationConfig(speed=0.1, turn_speed=0.4)
    kinematics = FR3.kinematics()
    q = FR3.arm.home
    hand = Teleoperator(Pushed(twist), ActionFilter(FR3, HZ), lambda: q, config)
    first = {ft.WRENCH: np.full(6, 1.0, np.float32), ft.STATE: np.full(15, 0.05, np.float32)}
    hand.start(first)
    action = hand.act({**first, ft.WRENCH: np.float32(1.0) + np.array(wrench, np.float32)})
    (before, R), (after, turned) = kinematics.forward(q), kinematics.forward(q + action[:-1])
    return after - before, rotation_vector(turned @ R.T), action[-1:]


def test_the_hand_moves_as_asked_and_yields_to_what_it_presses_on() -> None:
    moved, turned, width = act([1, -0.5, 0, 0, 0, 0])
    np.testing.assert_allclose(moved, [0.1 * TICK, -0.05 * TICK, 0], atol=1e-5)
    np.testing.assert_allclose([*turned, *width], 0, atol=1e-4)
    moved, turned, _ = act([0, 0, 0, 0, 0, 1])
    np.testing.assert_allclose(turned, [0, 0, 0.4 * TICK], atol=1e-4)
    np.testing.assert_allclose(moved, 0, atol=1e-5)
    still = np.concatenate(act([0] * 6, (0, 0, 2.9, 0, 0, 0.2)))  # what a carried object weighs
    assert not still.any()
    moved, _, _ = act([0, 0, -0.2, 0, 0, 0], (0, 0, 10.0, 0, 0, 0))
    np.testing.assert_allclose(moved, [0, 0, TICK * (2e-3 * 7 - 0.02)], atol=1e-5)
    _, turned, _ = act([0] * 6, (0, 0, 0, 0, 0, 0.5))
    np.testing.assert_allclose(turned, [0, 0, TICK * 0.5 * 0.2], atol=1e-5)


def test_a_policy_of_ones_own_task_yields_as_a_led_hand_does() -> None:
    kinematics, q = FR3.kinematics(), FR3.arm.home
    hand, still = YieldingHand(ActionFilter(FR3, HZ), lambda: q), np.append(np.zeros(7), 0.05)
    hand.start({ft.WRENCH: np.ones(6)})
    light = {ft.WRENCH: 1.0 + np.array([0, 0, 2.9, 0, 0, 0.5])}
    assert not hand.add_to(still, light)[:7].any()
    action = hand.add_to(still, {ft.WRENCH: 1.0 + np.array([0, 0, 10.0, 0, 0, 0])})
    moved = kinematics.forward(q + action[:7])[0] - kinematics.forward(q)[0]
    np.testing.assert_allclose([*moved, action[7]], [0, 0, TICK * 4e-3 * 7, 0.05], atol=1e-5)


CELL = """
arm = "sim"
gripper = { kind = "franka_hand" }
task = { name = "put it down", objects = ["golf_ball"], seconds = 2.0 }
"""


def test_own_demonstrations_train_a_policy_that_deploys(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At toy size: nothing is any good, and nothing knows more than the cell's sensors."""
    cell, down = write_cell_file(tmp_path, CELL), [0, 0, -0.5, 0, 0, 0]
    monkeypatch.setattr(record_demos, "_open_device", lambda *_: Pushed(down, ticks=20))
    monkeypatch.setattr(cell_run, "confirm", confirmed := MagicMock())
    for name, seed, episodes in (("train", 0, 2), ("validation", 100_000, 1)):
        run("record-demos", cell, "--device", "scripted", "--episodes", episodes, "--seed", seed,
            "--out", tmp_path / name)  # fmt: skip
    assert [len(call.args) for call in confirmed.call_args_list] == [2, 2]  # with the fingertips
    found = EpisodeSet(tmp_path / "train" / "episodes")
    assert len(found) == 2 and not any(key.startswith("truth.") for key in found.features)
    frames, meta = found.read(0).frames, found.meta(0)
    assert meta["task"] == "put it down" and meta["success"] and meta["policy"] == "scripted"
    assert frames[ft.TCP_POSE][-1, 2] < frames[ft.TCP_POSE][0, 2] - 0.02
    assert (frames[ft.ACTION][:, -1] == 0).all()
    said = json.loads((tmp_path / "train" / "metrics.json").read_text())["episodes"]
    assert len(said) == 2 and said[0]["progress"] is None  # no simulator is asked
    run("train-policy", "--data", tmp_path / "train" / "episodes", "--validation",
        tmp_path / "validation" / "episodes", "--head", "tiny", "--train.epochs", 1, "--workers", 1,
        "--out", tmp_path / "mine")  # fmt: skip
    assert "no simulator knows 'put it down'" in capsys.readouterr().out
    deploying = ["deploy", cell, "--policy", tmp_path / "mine", "--execute", "--yes"]
    with pytest.raises(SystemExit) as end:
        run(*deploying, "--out", tmp_path / "run")
    assert end.value.code == NOT_DONE  # time was up
    assert EpisodeSet(tmp_path / "run" / "episodes").meta(0)["task"] == "put it down"
    with pytest.raises(SystemExit, match="was trained for put it down, not for pick-place"):
        run(*deploying, "--task", "pick-place")


def test_the_script_errs_on_its_way_down_corrects_and_stands_still_at_the_end() -> None:
    ends = np.array([[0.5, 0.1], [0.4, -0.1]])  # of block and disc
    for seed in (0, 1):
        device = ScriptedDevice(PickPlacePoses((*ends[0], 0.02, 0.3), tuple(ends[1])), seed)
        position, R, width, way = np.array([0.45, 0.0, 0.25]), fingers_down(0.0), 0.08, []
        while not device.verdict:
            pose = np.append(position, Rotation.from_matrix(R).as_quat(scalar_first=True))
            motion = device.read({ft.TCP_POSE: pose, ft.STATE: np.array([width])})
            position = position + 0.01 * motion.twist[:3]
            R = rotation_matrix(0.05 * motion.twist[3:]) @ R
            way.append([*position, width := {"open": 0.08, "close": 0.03}[motion.gripper]])
        assert np.ptp(way[-7:], axis=0).max() < 4e-4 and way[-1][2] > 0.1  # it has left, and stands
        x_y, z, width = np.split(np.array(way), [2, 3], 1)
        np.testing.assert_allclose(x_y[(width < 0.05)[:, 0]][[0, -1]], ends, atol=0.005)
        low = np.abs(z[:, 0] - 0.09) < 0.01  # at the last way-point, 6 cm above the end
        assert np.abs(x_y[low, None] - ends).max(2).min(1).max() > 0.003


def test_a_person_leads_the_arm_by_keys(tmp_path: Path) -> None:
    """Led some way without a record, one success, one discarded, and no more: one is on disk."""
    cell = write_cell_file(tmp_path, CELL.replace("seconds = 2.0", "seconds = 60"))
    end, terminal = os.openpty()
    command = [sys.executable, "-m", "touchgoal.launch", "record-demos", str(cell), "--yes"]
    program = subprocess.Popen(
        [*command, "--out", str(tmp_path / "run")], stdin=terminal, stdout=terminal
    )
    typed = iter([("Enter begins", "f"), (" s  ", "\n"), ("RECORDING", "w"), (" s  ", "www\n"),
                  ("Enter begins", "\n"), ("RECORDING", "w"), (" s  ", "q"),
                  ("Enter begins", "q")])  # fmt: skip
    seen, (awaited, keys) = "", next(typed)
    while program.poll() is None:
        if select.select([end], [], [], 1)[0]:
            seen += os.read(end, 4096).decode()
        if awaited and awaited in seen:
            os.write(end, keys.encode())
            seen, (awaited, keys) = "", next(typed, ("", ""))
    assert program.returncode == 0 and not awaited, seen
    for one in (end, terminal):
        os.close(one)
    found = EpisodeSet(tmp_path / "run" / "episodes")
    assert len(found) == 1 and found.meta(0)["success"] and found.meta(0)["policy"] == "keyboard"
    assert found.read(0).frames[ft.ACTION][:, :-1].any()


def test_recording_needs_a_person(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cell = write_cell_file(tmp_path, CELL)
    monkeypatch.setattr("sys.stdin", open(os.devnull))
    with pytest.raises(SystemExit, match="nobody is there to lead the arm"):
        run("record-demos", cell, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()
