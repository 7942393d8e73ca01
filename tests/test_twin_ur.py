"""The twin's UR controller, through ur-rtde."""

import time
from typing import Any

import numpy as np
import pytest
from running_twin import RunningTwin, client

pytestmark = pytest.mark.realtime


def drives(address: str) -> dict:
    """Moves, stops, servoes at three rates, and falls silent."""
    from rtde_control import RTDEControlInterface
    from rtde_receive import RTDEReceiveInterface

    receive, control = RTDEReceiveInterface(address), RTDEControlInterface(address)

    def at() -> np.ndarray:
        return np.array(receive.getActualQ())

    start = at()
    result: dict[str, Any] = {}
    control.moveJ((start + 0.2).tolist(), 1.0, 2.0)
    result["move"] = float(np.abs(at() - start - 0.2).max())
    control.moveJ((start - 0.4).tolist(), 0.5, 2.0, True)
    time.sleep(0.4)
    control.stopJ(5.0)
    stopped = at()
    time.sleep(0.2)
    result["stop"] = float(np.abs(at() - stopped).max())
    result["short"] = float(np.abs(at() - start + 0.4).max())
    control.moveJ(start.tolist(), 1.0, 2.0)
    result["servo"] = []
    for rate in (20, 125, 500):
        began, worst, taken = time.monotonic(), 0.0, True
        while (now := time.monotonic() - began) < 0.8:
            goal = start.copy()
            goal[0] += 0.1 * np.sin(2 * now)
            taken &= control.servoJ(goal.tolist(), 0, 0, 1 / rate, 0.1, 300)
            worst = max(worst, abs(at()[0] - goal[0]))
            time.sleep(max(0.0, 1 / rate - (time.monotonic() - began - now)))
        control.servoStop()
        result["servo"].append([taken, worst])
    control.moveJ(start.tolist(), 1.0, 2.0)
    pose = receive.getActualTCPPose()
    control.moveL([*pose[:2], pose[2] - 0.05, *pose[3:]], 0.2, 0.5)
    result["line"] = (np.array(receive.getActualTCPPose())[:3] - pose[:3]).tolist()
    control.setWatchdog(10)
    for _ in range(10):
        control.kickWatchdog()
        time.sleep(0.03)
    result["kicked"] = control.isProgramRunning()
    time.sleep(1.0)
    result["silent"] = control.isProgramRunning()
    return result


def test_ur_moves_servoes_and_watches(ur5e: RunningTwin) -> None:
    result = client(drives, ur5e.cell.address)
    assert result["move"] < 2e-3 and result["stop"] < 2e-3 and result["short"] > 0.1
    for taken, worst in result["servo"]:
        assert taken and worst < 0.1  # rad behind a goal at 0.2 rad/s, on a loaded machine
    np.testing.assert_allclose(result["line"], [0, 0, -0.05], atol=2e-3)
    assert result["kicked"] and not result["silent"]
    assert ur5e.ask("truth")["worst"]["excess"] <= 0
