"""ur-rtde against the address given: moves, servoJ, dashboard.

It answers with one line of JSON; `run.py` judges it.
"""

import json
import os
import sys
import time

import numpy as np
from dashboard_client import DashboardClient
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface


def main(address: str) -> None:
    """All of it on one arm."""
    receive, control = RTDEReceiveInterface(address), RTDEControlInterface(address)
    said: dict[str, object] = {}
    start = np.array(receive.getActualQ())

    def moved() -> list[float]:
        return (np.array(receive.getActualQ()) - start).tolist()

    control.moveJ((start + 0.1).tolist(), 0.5, 1.0)
    said["moveJ"] = moved()
    control.moveJ(start.tolist(), 0.5, 1.0)
    pose = np.array(receive.getActualTCPPose())
    control.moveL((pose + [0, 0, 0.05, 0, 0, 0]).tolist(), 0.1, 0.5)
    said["moveL"] = (np.array(receive.getActualTCPPose()) - pose)[:3].tolist()
    control.moveJ(start.tolist(), 0.5, 1.0)
    for _ in range(250):
        control.servoJ((start + [0.05, 0, 0, 0, 0, 0]).tolist(), 0, 0, 0.008, 0.1, 300)
        time.sleep(0.008)
    control.servoStop()
    said["servoJ"] = moved()
    control.moveJ(start.tolist(), 0.5, 1.0)
    dashboard = DashboardClient(address)
    dashboard.connect()
    said["dashboard"] = [dashboard.robotmode(), dashboard.safetystatus(), dashboard.running()]
    control.stopScript()
    print(json.dumps(said), flush=True)
    os._exit(0)  # ur-rtde's threads may outlive the interpreter


if __name__ == "__main__":
    main(sys.argv[1])
