"""A Franka Hand's driver and the environment that trains for it send the hand the same commands."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchgoal.control.grippers.franka_hand import FrankaHandClient
from touchgoal.control.interfaces import DriverError
from touchgoal.control.safety.limits import FR3
from touchgoal.sim_envs.cell.deployed_arm import DeployedHand

LOOK = 50  # ms
OPEN = 0.08  # m


class Fingers:
    """Fingers with something between them, in steps of 1 ms."""

    def __init__(self, between: float) -> None:
        self.between, self.at = between, OPEN

    def width(self) -> float:
        return self.at

    def go(self, goal: float) -> None:
        step = min(max(goal - self.at, -1e-4), 1e-4)  # 0.1 m/s
        self.at = max(self.at + step, min(self.between, self.at))


class Franky:
    """franky's gripper over such fingers; a command has ended once they have arrived or stand still."""

    def __init__(self, fingers: Fingers) -> None:
        self.fingers, self.goal, self.commands = fingers, fingers.at, []
        self._before, self._age, self._grasps, self._ended = fingers.at, 0, False, True
        self._looks = 0

    @property
    def state(self) -> Any:
        self._looks += 1
        time = SimpleNamespace(to_msec=lambda: self._looks)
        grasped = self._grasps and self._ended and self.fingers.at > 0.002
        return SimpleNamespace(width=self.fingers.at, max_width=OPEN, is_grasped=grasped, time=time)

    def look(self) -> None:
        self._age += 1
        still = abs(self.fingers.at - self._before) < 2e-4
        self._ended |= self._age > 2 and (abs(self.fingers.at - self.goal) < 1e-3 or still)
        self._before = self.fingers.at

    def wait(self, seconds: float) -> bool:
        return self._ended

    def get(self) -> bool:
        return abs(self.fingers.at - self.goal) < 1e-3

    def _begin(self, goal: float, grasps: bool) -> "Franky":
        self.goal, self._grasps, self._ended, self._age = goal, grasps, False, 0
        self.commands.append(("grasp" if grasps else "move", round(goal, 4)))
        return self

    def move_async(self, width: float, speed: float) -> "Franky":
        return self._begin(width, False)

    def grasp_async(self, *_: float, **__: float) -> "Franky":
        return self._begin(0.0, True)

    def stop_async(self) -> "Franky":
        return self._begin(self.fingers.at, False)


def connected(monkeypatch: pytest.MonkeyPatch, between: float) -> tuple[FrankaHandClient, Franky]:
    hand = Franky(Fingers(between))
    monkeypatch.setattr(
        "touchgoal.control.arms.client_libraries.ClientLibrary.load",
        lambda *_: SimpleNamespace(Gripper=lambda address: hand),
    )
    return FrankaHandClient("here", 30.0), hand


def driven(monkeypatch: pytest.MonkeyPatch, wanted: list[float], between: float) -> tuple:
    """Return the widths (m, every ms) for these targets, one a look, and the driver's commands."""
    client, hand = connected(monkeypatch, between)
    widths = []
    for width in wanted:
        client.command(width)
        hand.look()
        client.tick()
        for _ in range(LOOK):
            hand.fingers.go(hand.goal)
            widths.append(hand.fingers.at)
    assert not client.read().fault
    return np.array(widths), hand.commands


def simulated(wanted: list[float], between: float) -> np.ndarray:
    """Return the widths that the environment's hand makes of the same targets."""
    fingers, widths = Fingers(between), []
    hand = DeployedHand(fingers.width, FR3.tool.stroke[1], np.random.default_rng(0))
    phase = int(np.random.default_rng(0).integers(LOOK))  # of its looks
    for ms in range(LOOK * len(wanted)):
        fingers.go(hand.step(ms + phase, wanted[ms // LOOK]))
        widths.append(fingers.at)
    return np.array(widths)


SEQUENCES = {  # widths that are asked for, and the commands that they make
    "passes": ([OPEN, 0.03, OPEN, OPEN, OPEN, OPEN], []),
    "goes on passing": (
        [OPEN, 0.07, 0.06, 0.05, 0.04, 0.03, *[0.02] * 20],
        [("move", 0.04), ("move", 0.02)],
    ),
    "stays": ([OPEN, *[0.03] * 12, *[OPEN] * 20], [("move", 0.03), ("move", 0.08)]),
    "a move meets something": (
        [OPEN, *[0.03] * 20, 0.02, 0.02, 0.02, *[0.07] * 10],
        [("move", 0.03), ("grasp", 0.0), ("move", 0.07)],
    ),
    "a move meets something when it is to open": (
        [OPEN, *[0.03] * 10, *[OPEN] * 20],
        [("move", 0.03), ("move", 0.08)],
    ),
    "a grasp goes on": (
        [OPEN, *[0.0] * 20, *[0.01] * 5, *[0.03] * 5, *[OPEN] * 20],
        [("grasp", 0.0), ("move", 0.08)],
    ),
}


@pytest.mark.parametrize("name", SEQUENCES)
def test_driver_and_environment_send_the_same(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (wanted, expected), between = SEQUENCES[name], 0.04 if name.startswith("a ") else 0.0
    widths, commands = driven(monkeypatch, wanted, between)
    assert commands == expected
    np.testing.assert_array_equal(simulated(wanted, between), widths)


def test_driver_and_environment_agree_whatever_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    for _ in range(30):
        widths = rng.choice([0.0, 0.001, 0.01, 0.03, 0.05, OPEN, 0.2], 12)
        wanted = np.repeat(widths, rng.integers(1, 12, 12)).tolist()
        between = float(rng.choice([0.0, 0.02, 0.045]))
        expected, commands = driven(monkeypatch, wanted, between)
        assert commands
        np.testing.assert_array_equal(simulated(wanted, between), expected)


@pytest.mark.parametrize(
    ("release_to", "commands"),
    [
        (None, [("move", 0.02), ("move", 0.08)]),  # stopped where it is, and no grasp
        (0.07, [("move", 0.02), ("move", 0.08), ("move", 0.07)]),
    ],
)
def test_a_stopped_hand_takes_no_more_commands_but_to_let_go(
    release_to: float | None, commands: list, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, hand = connected(monkeypatch, between=0.04)
    client.command(0.02)
    for _ in range(2):  # a width that stays is sent, one that passes is not
        client.tick()
    client.stop(release_to)
    hand._ended = True
    for _ in range(3):
        client.tick()
    assert hand.commands == commands
    with pytest.raises(DriverError, match="stopped"):
        client.command(0.05)
