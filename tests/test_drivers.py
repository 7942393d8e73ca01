"""One contract for all drivers, against the twin: vendors' client libraries over the wire."""

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numbered_images import until
from running_twin import RunningTwin

from touchgoal.control.arms import franka
from touchgoal.control.arms.driver_process import DriverProcess
from touchgoal.control.arms.streaming import ArmConfig, ArmProcess
from touchgoal.control.cell.connection import _gripper, connect_arm
from touchgoal.control.cell.limits import cell_limits
from touchgoal.control.interfaces import Arm, DriverError, Gripper
from touchgoal.control.safety.limits import FR3

pytestmark = pytest.mark.realtime

# A parent that moves the arm and is then killed; its first line of output says that it moves.
DRIVING = """
import sys, time
from dataclasses import replace
from pathlib import Path
from touchgoal.control.cell.cell_file import read_cell_file
from touchgoal.control.cell.connection import connect_arm
cell = read_cell_file(Path(sys.argv[1]))
arm = connect_arm(replace(cell, safety=replace(cell.safety, state_timeout=0.5)))
q = arm.read().q
while True:
    q[0] += 0.01
    arm.command(q)
    time.sleep(0.05)
    if arm.read().velocity[0] > 0.1:
        print("moves", flush=True)
"""


class Twin(RunningTwin):
    """A twin in real time."""

    def __init__(self, name: str, out: Path) -> None:
        blind = ["--env.cameras", "front", "--env.no-tactile"]  # a processor's time
        number = 20 + ("fr3", "ur5e").index(name)
        super().__init__(["--arm", name, "--seed", "3", *blind], out, number)
        self.name, self.robot = name, cell_limits(self.cell)

    def connect(self, recover: bool = False) -> ArmProcess:
        safety = replace(self.cell.safety, state_timeout=0.5)  # on a machine however loaded
        return connect_arm(replace(self.cell, safety=safety), recover)


@pytest.fixture(scope="module", params=["fr3", "ur5e"])
def twin(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Twin]:
    twin = Twin(request.param, tmp_path_factory.mktemp(request.param))
    yield twin
    twin.close()


@pytest.fixture
def arm(twin: Twin) -> Iterator[ArmProcess]:
    twin.at_rest()
    arm = twin.connect()
    yield arm
    arm.close()


def swing(arm: Arm, ticks: int = 10, change: float = 0.01) -> np.ndarray:
    """Turns the base by `change` rad a tick; the last target."""
    target = arm.read().q
    for _ in range(ticks):
        target = target + change * np.eye(target.size)[0]
        arm.command(target)
        time.sleep(0.05)
    return target


def arrives(arm: Arm, target: np.ndarray) -> None:
    until(lambda: bool(np.abs(arm.read().q - target).max() < 5e-3))


def test_an_arm_reads_fresh_follows_and_rests_at_the_last_target(twin: Twin, arm: Arm) -> None:
    first, n = arm.read(), twin.robot.arm.home.size
    assert isinstance(arm, Arm) and first.fault == ""
    assert first.q.shape == first.velocity.shape == first.torque.shape == (n,)
    until(lambda: arm.read().stamp > first.stamp)
    target = swing(arm)
    arrives(arm, target)
    twin.at_rest()
    np.testing.assert_allclose(twin.ask("truth")["q"], target, atol=5e-3)
    assert arm.read().stamp > first.stamp + 0.4 and arm.read().fault == ""


def recover(twin: Twin, arm: Arm) -> str:
    """Recovers as `touchgoal arm recover` does; why that fails, "" if it does not."""
    arm.close()
    try:
        with closing(twin.connect(recover=True)) as again:
            return again.read().fault
    except DriverError as error:
        return str(error)


def follows_again(twin: Twin) -> None:
    with closing(twin.connect()) as arm:
        arrives(arm, swing(arm, change=-0.01))


def test_a_stopped_arm_rests_and_refuses_until_recovered(twin: Twin, arm: Arm) -> None:
    swing(arm)
    arm.stop()
    twin.at_rest()
    assert "stopped" in arm.read().fault
    with pytest.raises(DriverError, match="stopped"):
        arm.command(arm.read().q)
    assert recover(twin, arm) == ""
    follows_again(twin)


def test_an_error_of_the_controller_is_said_and_kept_until_recovered(twin: Twin, arm: Arm) -> None:
    error = {"fr3": "cartesian_reflex", "ur5e": "protective_stop"}[twin.name]
    swing(arm)
    twin.ask(f"error {error}")
    words = error.replace("_", " ") if twin.name == "ur5e" else error
    until(lambda: words in arm.read().fault)
    twin.at_rest()
    with pytest.raises(DriverError, match=words):
        arm.command(arm.read().q)
    until(lambda: not recover(twin, arm))  # a UR5e is locked for the first 5 s
    follows_again(twin)


def test_a_frozen_link_stops_the_arm_and_is_said(twin: Twin, arm: Arm) -> None:
    swing(arm)
    twin.ask("freeze 1.5")
    until(lambda: "no state" in arm.read().fault)
    lost = arm.read()
    with pytest.raises(DriverError, match="no state"):
        arm.command(lost.q)
    arm.stop()
    assert arm.read().stamp == lost.stamp
    twin.at_rest()
    until(lambda: not recover(twin, arm))
    follows_again(twin)


def test_a_pressed_stop_is_not_recovered_by_software(twin: Twin, arm: Arm) -> None:
    swing(arm)
    twin.ask("stop-button on")
    until(lambda: "user stop" in arm.read().fault or "emergency stop" in arm.read().fault)
    assert "stop" in recover(twin, arm)
    twin.at_rest()
    twin.ask("stop-button off")
    if twin.name == "ur5e":  # it took the power off; a person switches it on at the pendant
        with socket.create_connection((twin.cell.address, 29999), timeout=10) as pendant:
            answers = pendant.makefile()
            answers.readline()
            for line in ("power on", "brake release"):
                pendant.sendall(line.encode() + b"\n")
                answers.readline()
    until(lambda: not recover(twin, arm))


def test_a_killed_program_leaves_the_arm_at_rest(twin: Twin) -> None:
    parent = subprocess.Popen(
        [sys.executable, "-c", DRIVING, str(twin.cell_file)], stdout=subprocess.PIPE
    )
    assert parent.stdout and parent.stdout.readline() == b"moves\n"
    parent.kill()
    parent.wait()
    twin.at_rest()


def rests_at(gripper: Gripper, width: float) -> bool:
    """Whether the fingers are at a width (m) and still there a while later."""
    for _ in range(5):
        if abs(gripper.read().width - width) > 2e-3:
            return False
        time.sleep(0.05)
    return True


def test_a_gripper_opens_closes_and_is_clipped_to_its_stroke(twin: Twin) -> None:
    gripper = _gripper(twin.cell)
    assert isinstance(gripper, Gripper)
    stamp, widest = gripper.read().stamp, twin.robot.tool.stroke[1]
    for asked, width in ((0.06, 0.06), (0.03, 0.03), (9.0, widest)):
        gripper.command(asked)
        until(lambda w=width: rests_at(gripper, w))
    assert gripper.read().fault == "" and gripper.read().stamp > stamp
    gripper.stop()
    gripper.close()


def test_a_taken_franka_is_said_and_not_waited_for(twin: Twin) -> None:
    if twin.name != "fr3":
        pytest.skip("a UR takes several clients")
    arm = twin.connect()
    with pytest.raises(DriverError, match="no other program"):
        config = ArmConfig(twin.cell.address, FR3, franka.RATE, 0.5)
        DriverProcess(franka.FrankaClient, config, False, connect_timeout=3.0)
    arm.close()
