"""A person at a terminal: keys that push the hand, runs that are recorded or given up."""

import json
import os
import select
import subprocess
import sys
import termios
from pathlib import Path

import numpy as np
import pytest

from touchgoal.control import features as ft
from touchgoal.control.sensors.keyboard import Keyboard
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.config import BeadMazeConfig, TeleoperatorConfig
from touchgoal.sim_envs.experts.teleoperator import Teleoperator

STRAIGHT = "arc-2000009"  # nearly: it turns by 7 degrees
UP, TICK = np.array([0.0, 0.0, 1.0]), 0.05


@pytest.fixture(scope="module")
def maze():
    env = BeadMaze(BeadMazeConfig(tactile=False))
    env.reset(seed=0, options={"wire": STRAIGHT})
    while env.grasping:
        env.step(np.zeros(8))
    yield env
    env.close()


def moved(
    maze: BeadMaze, hand: Teleoperator, wrench: tuple[float, ...] = (0.0,) * 6
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return an action's displacement of the hand (m), and its rotation before and after."""
    before, R = maze.kinematics.forward(maze.command)
    action = hand.act({ft.WRENCH: np.array(wrench, np.float32)})
    assert action[-1] == 0  # the gripper stays closed
    after, turned = maze.kinematics.forward(maze.command + action[:-1])
    return after - before, R, turned


def test_keys_push_the_hand_as_it_is_turned(maze: BeadMaze) -> None:
    hand = Teleoperator(maze, TeleoperatorConfig(speed=0.02))
    _, heading = maze.wire.at(maze.arc_length)
    right = np.cross(heading, UP) / np.linalg.norm(np.cross(heading, UP))
    up = np.cross(right, heading)
    for keys, way in (("w", heading), ("d", right), ("r", up), ("wd", heading + right)):
        opposite = keys.translate(str.maketrans("wdr", "saf"))
        for typed, sign in ((keys, 1), (opposite, -1)):
            hand.press(" " + typed)
            step, before, after = moved(maze, hand)
            np.testing.assert_allclose(step, sign * 0.02 * TICK * way, atol=3e-5)
            np.testing.assert_allclose(after, before, atol=2e-4)


@pytest.mark.parametrize(
    ("left", "right", "axis"),
    [("j", "l", [0, 0, -1]), ("i", "k", [0, 1, 0]), ("o", "u", [1, 0, 0])],
)
def test_keys_turn_the_hand(maze: BeadMaze, left: str, right: str, axis: list[int]) -> None:
    """Left seen from above, nose up, right side down: about the hand's x ahead, y right, z down."""
    hand = Teleoperator(maze, TeleoperatorConfig(turn_speed=0.4))
    for key, sign in ((left, 1), (right, -1)):
        hand.press(" " + key)
        step, before, after = moved(maze, hand)
        turn = before.T @ after
        vector = np.array(
            [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        )
        np.testing.assert_allclose(vector / 2, sign * 0.4 * TICK * np.array(axis), atol=3e-4)
        np.testing.assert_allclose(step, 0, atol=3e-5)


def test_a_key_is_held_until_its_time_its_opposite_or_space(maze: BeadMaze) -> None:
    hand = Teleoperator(maze, TeleoperatorConfig(hold_seconds=0.2))
    hand.press("wx\x1b[A")  # the last ones mean nothing
    speeds = [np.linalg.norm(moved(maze, hand)[0]) / TICK for _ in range(5)]
    np.testing.assert_allclose(speeds, [0.025] * 4 + [0], atol=1e-3)
    hand.press("wr")
    hand.press("s")
    assert hand.held == "rs"
    hand.press(" ")
    assert hand.held == "" and np.linalg.norm(moved(maze, hand)[0]) < 1e-5


def test_the_hand_gives_way_to_the_wire(maze: BeadMaze) -> None:
    hand = Teleoperator(maze, TeleoperatorConfig(compliance=2e-3, rotational_compliance=2.0))
    step, before, after = moved(maze, hand, (0.0, 5.0, 0.0, 0.0, 0.0, 0.1))
    np.testing.assert_allclose(step, [0, 5 * 2e-3 * TICK, 0], atol=3e-5)
    turn = after @ before.T
    assert turn[1, 0] == pytest.approx(0.1 * 2.0 * TICK, abs=3e-4)


def test_a_person_leads_the_bead(tmp_path: Path) -> None:
    """One run to the time limit, one given up, Ctrl-C in the third: the first is on disk."""
    end, terminal = os.openpty()
    settings = termios.tcgetattr(terminal)
    command = [sys.executable, "-m", "touchgoal.launch", "teleop", "--episodes", "3"]
    options = ["--env.wires", STRAIGHT, "--env.max-seconds", "3", "--hand.speed", "0.05"]
    program = subprocess.Popen(
        [*command, *options, "--out", str(tmp_path)], stdin=terminal, stdout=terminal
    )
    typed, seen = {"1 of 3": "w", "2 of 3": "q", "3 of 3": "\x03"}, ""
    while program.poll() is None and "episodes saved" not in seen:
        assert select.select([end], [], [], 60)[0], seen
        seen += os.read(end, 4096).decode()
        header = max(typed, key=seen.rfind)
        if "of the way" in seen[seen.rfind(header) :] and typed[header]:
            os.write(end, typed[header].encode())
            typed[header] = "w" if header == "1 of 3" else ""
    assert program.wait(20) == 130 and "1 of 3 episodes saved" in seen
    assert "out of time" in seen and "given up" in seen
    assert termios.tcgetattr(terminal) == settings
    for one in (end, terminal):
        os.close(one)
    found = EpisodeSet(tmp_path / "episodes")
    episode = found.read(0)
    assert len(found) == 1 and found.lengths == [61] and found.meta(0)["wire"] == STRAIGHT
    assert found.meta(0)["outcome"] == "failure"  # time was up
    progress = episode.frames[ft.TRUTH_PROGRESS][:, 0]
    assert progress[-1] > 0.2 and not episode.frames[ft.TRUTH_FAILURE].any()
    assert np.abs(episode.frames[ft.ACTION][20:-1, :7]).max() > 1e-3
    assert episode.frames[ft.TACTILE_LEFT].shape == (61, 240, 320, 3)
    assert json.loads((tmp_path / "metrics.json").read_text())["episodes"][0]["seed"] == 0


def test_a_terminal_that_goes_is_said() -> None:
    end, terminal = os.openpty()
    with os.fdopen(terminal) as stream, Keyboard(stream) as keyboard:
        os.write(end, b"w d")
        select.select([terminal], [], [], 5)
        assert keyboard.read_keys() == "w d" and keyboard.read_keys() == ""
        os.close(end)
        with pytest.raises(UserError, match="the terminal has gone"):
            keyboard.read_keys()
