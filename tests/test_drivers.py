"""Arm drivers through the vendors' client libraries, over the wire: one contract for all.

The FR3 here is franky-sim's server, which has neither reflexes nor limits.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from touchgoal.control import franka
from touchgoal.control.arm_process import ArmConfig, ArmProcess, moved_wrench
from touchgoal.control.errors import UserError
from touchgoal.control.franka_hand import FrankaHand
from touchgoal.control.kinematics import GELSIGHT_TCP
from touchgoal.control.limits import FR3
from touchgoal.control.protocols import Arm, DriverError

pytest.importorskip("franky", reason="pip install 'touchgoal[franka]'")
pytest.importorskip("pinocchio", reason="franky-sim's server needs it")

HZ = 20.0
ADDRESS = f"127.0.77.{os.getpid() % 250 + 1}"
CONFIG = ArmConfig(ADDRESS, FR3, GELSIGHT_TCP, HZ, franka.RATE)


def serve() -> subprocess.Popen[str]:
    options = ["-s", "mujoco", "--hostname", ADDRESS]
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "franky_sim.run_server", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout
    assert any("Press Ctrl+C" in line for line in process.stdout)
    return process


@pytest.fixture(scope="module")
def server() -> Iterator[subprocess.Popen[str]]:
    process = serve()
    yield process
    process.kill()
    process.wait()


@pytest.fixture
def arm(server: subprocess.Popen[str]) -> Iterator[ArmProcess]:
    arm = franka.franka(CONFIG)
    yield arm
    arm.close()


def until(holds: Callable[[], bool], seconds: float = 8.0) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it does not happen"
        time.sleep(0.02)


def drive(arm: Arm, change: np.ndarray, ticks: int) -> np.ndarray:
    """Targets at 20 Hz, `change` (rad) on from tick to tick; the last one."""
    target = arm.read().q
    for _ in range(ticks):
        target = target + change
        arm.command(target)
        time.sleep(1 / HZ)
    return target


def at_rest(arm: Arm) -> bool:
    before = arm.read().q
    time.sleep(0.1)
    return bool(np.abs(arm.read().q - before).max() < 2e-3)


def test_an_arm_reads_fresh_follows_and_rests_at_the_last_target(arm: Arm) -> None:
    first = arm.read()
    assert first.fault == "" and first.q.shape == first.velocity.shape == first.torque.shape == (7,)
    until(lambda: arm.read().stamp > first.stamp)
    assert abs(arm.read().stamp - time.monotonic()) < 1
    target = drive(arm, np.array([1, -1, 1, 1, -1, 1, 1]) * 0.01, 12)
    until(lambda: bool(np.abs(arm.read().q - target).max() < 5e-3))
    time.sleep(0.3)
    assert at_rest(arm) and np.abs(arm.read().q - target).max() < 5e-3


def test_a_stopped_arm_rests_and_refuses_until_recovered(arm: Arm) -> None:
    drive(arm, np.eye(7)[0] * 0.01, 10)
    arm.stop()
    until(lambda: at_rest(arm))
    assert "stopped" in arm.read().fault
    with pytest.raises(DriverError, match="stopped"):
        arm.command(arm.read().q)
    arm.recover()
    assert arm.read().fault == ""
    target = drive(arm, -np.eye(7)[0] * 0.01, 5)
    until(lambda: bool(np.abs(arm.read().q - target).max() < 5e-3))


def test_targets_beyond_the_range_are_refused(arm: Arm) -> None:
    q = arm.read().q
    for bad in (3.5, np.nan, -np.inf):
        with pytest.raises(UserError, match="range"):
            arm.command(np.where(np.arange(7) == 0, bad, q))
    assert arm.read().fault == ""


def test_a_silent_controller_ends_the_driver_and_is_said(
    server: subprocess.Popen[str], arm: Arm
) -> None:
    drive(arm, np.eye(7)[0] * 0.01, 5)
    server.send_signal(signal.SIGSTOP)
    until(lambda: "no state" in arm.read().fault)
    lost = arm.read()
    with pytest.raises(DriverError, match="no state"):
        arm.command(lost.q)
    arm.stop()
    assert arm.read().stamp == lost.stamp
    server.send_signal(signal.SIGCONT)
    until(lambda: recovered(arm))
    target = drive(arm, -np.eye(7)[0] * 0.01, 5)
    until(lambda: bool(np.abs(arm.read().q - target).max() < 5e-3))


def recovered(arm: Arm) -> bool:
    try:
        arm.recover()
    except DriverError:
        return False
    return True


def test_a_taken_arm_is_said_and_not_waited_for(server: subprocess.Popen[str]) -> None:
    arm = franka.franka(CONFIG)
    with pytest.raises(DriverError, match="no other program"):
        ArmProcess(franka.FrankaClient, CONFIG, connect_timeout=2.0)
    arm.close()


def test_the_franka_hand_opens_closes_and_says_so(server: subprocess.Popen[str], arm: Arm) -> None:
    hand = FrankaHand(ADDRESS)
    hand.command(0.06)
    until(lambda: abs(hand.read().width - 0.06) < 2e-3)
    stamp = hand.read().stamp
    hand.command(0.02)
    until(lambda: hand.read().grasped)
    assert abs(hand.read().width - 0.02) < 3e-3 and hand.read().stamp > stamp
    hand.command(9.0)  # clipped to the stroke
    until(lambda: hand.read().width > 0.07)
    hand.stop()
    hand.close()


def test_a_wrench_is_moved_with_its_lever() -> None:
    down = np.array([0, 0, -10.0, 0, 0, 0])
    moved = moved_wrench(down, np.array([0.1, 0, 0]), np.zeros(3))
    np.testing.assert_allclose(moved, [0, 0, -10, 0, 1, 0])


def test_a_killed_controller_is_said(server: subprocess.Popen[str]) -> None:
    """The last test: it takes the server away."""
    arm = franka.franka(CONFIG)
    drive(arm, np.eye(7)[0] * 0.01, 3)
    server.kill()
    server.wait()
    until(lambda: arm.read().fault != "")
    with pytest.raises(DriverError, match="FCI"):
        arm.recover()
    arm.close()
