"""Our driver of the FR3 and of its hand against simulated controllers that are not ours.

    python tests/interop/emulators.py [NAME ...]      NAME: franka-sim, franky-sim; none: both

Each runs in `.venv-interop` (`make interop` makes it), in real time; franka-sim aborts what breaks the FCI's
motion limits. Clients that are not ours (franky, ur-rtde) drive the twin in test_twin.py.
"""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from touchgoal.control.arms import franka
from touchgoal.control.arms.streaming import ArmConfig, ArmProcess
from touchgoal.control.grippers.franka_hand import FrankaHand
from touchgoal.control.interfaces import ArmReading, DriverError
from touchgoal.control.safety.limits import FR3

HERE = Path(__file__).parent
PYTHON = HERE.parents[1] / ".venv-interop" / "bin" / "python"
HZ, SECONDS = 20.0, 10.0
_SWING = 0.2 * np.array([1, 0.5, -1, 1, 1, -1, 1])  # rad, there and back in 4 s
_PERIOD = 4.0  # s
_START_TIMEOUT = 60.0  # s
_REST = 2.0  # s of the controller's clock after which all is at rest
_WIDTH = 0.03  # m
# rad off at the end. franka-sim's arm follows velocities and holds no position (its ARM_VELOCITY_KV):
# where it is late it drifts from the q_d that it reports, and that is what a driver steers.
_ARRIVED = {"franka-sim": 0.1, "franky-sim": 5e-3}

COMMANDS = {
    "franka-sim": ["franka_sim_server.py", "{address}"],
    "franky-sim": ["-m", "franky_sim.run_server", "-s", "mujoco", "--hostname", "{address}"],
}


def drive(name: str) -> tuple[dict[str, bool], str]:
    """Drive a controller; return the checks and figures."""
    network = 80 + list(COMMANDS).index(name)
    address = f"127.{network}.{os.getpid() // 250 % 250}.{1 + os.getpid() % 250}"
    command = [part.format(address=address) for part in COMMANDS[name]]
    server = subprocess.Popen(
        [PYTHON, *command], cwd=HERE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        arm = _connect(server, address)
        hand = FrankaHand(address)
        try:
            return _swing(arm, hand, _ARRIVED[name])
        finally:
            arm.close()
            hand.close()
    finally:
        server.terminate()
        server.wait(_START_TIMEOUT)


def _connect(server: subprocess.Popen[bytes], address: str) -> ArmProcess:
    end = time.monotonic() + _START_TIMEOUT
    while True:
        try:
            return ArmProcess(
                franka.FrankaClient, ArmConfig(address, FR3, franka.RATE, franka.STATE_TIMEOUT)
            )
        except DriverError:  # nobody listens yet
            assert server.poll() is None and time.monotonic() < end, "the server does not start"
            time.sleep(0.5)


def _swing(arm: ArmProcess, hand: FrankaHand, tolerance: float) -> tuple[dict[str, bool], str]:
    first = arm.read()
    hand.command(_WIDTH)
    began, behind, reading = time.monotonic(), 0.0, first
    for k in range(1, int(HZ * SECONDS) + 1):
        turn = np.sin(np.pi * k / HZ / _PERIOD) ** 2
        q = first.q + turn * _SWING
        if not reading.fault:
            arm.command(q)
        time.sleep(max(0.0, began + k / HZ - time.monotonic()))
        reading = arm.read()
        behind = max(behind, float(np.abs(reading.q - q).max()))
    pace = (reading.time - first.time) / (time.monotonic() - began)
    _wait(arm, _REST)
    arrived = _distance(arm.read(), q)
    arm.stop()
    _wait(arm, _REST)
    # Their last joint trembles: its velocity says 0.08 rad/s where the arm stands.
    stopped = arm.read().q
    _wait(arm, _REST / 4)
    found = {
        "no fault": not reading.fault,
        "arrives": arrived < tolerance,
        "at rest after a stop": _distance(arm.read(), stopped) < 1e-3,
        "hand": abs(hand.read().width - _WIDTH) < 2e-3,
    }
    figures = f"at most {behind:.3f} rad behind, {arrived:.4f} at the end, {pace:.2f} of real time"
    return found, f"{figures} {reading.fault}".rstrip()


def _distance(reading: ArmReading, q: np.ndarray) -> float:
    return float(np.abs(reading.q - q).max())


def _wait(arm: ArmProcess, seconds: float) -> None:
    """Until the controller's clock, which may go slower than ours, has gone on."""
    end = arm.read().time + seconds
    while arm.read().time < end:
        time.sleep(0.05)


def main() -> None:
    right = True
    for name in sys.argv[1:] or COMMANDS:
        found, figures = drive(name)
        checks = ", ".join(f"{what} {'ok' if ok else 'WRONG'}" for what, ok in found.items())
        print(f"{name}: {figures}\n{name}: {checks}", flush=True)
        right &= all(found.values())
    sys.exit(0 if right else 1)


if __name__ == "__main__":
    main()
