"""Swing a twin's arm through lerobot's robot interface, lead it by a SpaceMouse in lerobot-record and replay that
by lerobot-replay; run by lerobot_plugins.py in lerobot's Python.

python tests/interop/lerobot_arm.py CELL.json FOLDER
"""

import os
import struct
import sys
from fcntl import F_SETFL, fcntl
from functools import partial
from pathlib import Path
from threading import Event, Thread

import numpy as np
from lerobot.robots.utils import make_robot_from_config
from lerobot.utils.import_utils import register_third_party_plugins

TICKS = 20
SECONDS, FULL = 6.0, 350  # of recording; counts of a SpaceMouse at full deflection


class PushedSpaceMouse(Thread):
    """Reports of a cap that is pulled up, on a pipe in place of the kernel's device."""

    def __init__(self, folder: Path) -> None:
        super().__init__(daemon=True)
        self.root, self.devices = folder / "sys", folder / "dev"
        (self.root / "hidraw0" / "device").mkdir(parents=True)
        (self.root / "hidraw0" / "device" / "uevent").write_text("HID_ID=0003:0000256F:0000C635\n")
        self.devices.mkdir()
        os.mkfifo(self.devices / "hidraw0")
        self.ended = Event()

    def run(self) -> None:
        with (self.devices / "hidraw0").open("wb", buffering=0) as pipe:
            fcntl(pipe, F_SETFL, os.O_WRONLY | os.O_DIRECT)  # one report a read, as hidraw has it
            while not self.ended.wait(0.02):
                pipe.write(struct.pack("<B3h", 1, 0, 0, -FULL // 2))  # the device's z is down


def record_and_replay(cell: str, folder: Path) -> None:
    """Record a hand that rises, by lerobot-record; replayed, it rises as much."""
    import lerobot_teleoperator_touchgoal as plugin
    from lerobot.configs.dataset import DatasetRecordConfig
    from lerobot.datasets import LeRobotDataset
    from lerobot.scripts import lerobot_record, lerobot_replay
    from lerobot_robot_touchgoal import TouchgoalRobotConfig

    mouse = PushedSpaceMouse(folder)
    mouse.start()
    plugin.SpaceMouse = partial(plugin.SpaceMouse, mouse.root, mouse.devices)
    robot = TouchgoalRobotConfig(cell=cell, yes=True, columns=["state", "tcp_pose"], actions="hand")
    about = {"fps": 20, "episode_time_s": SECONDS, "num_episodes": 1, "push_to_hub": False}
    led = DatasetRecordConfig("lab/led", "lift the hand", root=folder / "led", video=False, **about)
    teleop = plugin.TouchgoalTeleoperatorConfig(device="spacemouse")
    recorded = lerobot_record.record(
        lerobot_record.RecordConfig(robot=robot, dataset=led, teleop=teleop, play_sounds=False)
    )
    mouse.ended.set()
    found = LeRobotDataset(recorded.repo_id, root=recorded.root)
    names = found.features["observation.state"]["names"]
    height = np.array(
        [found[i]["observation.state"][names.index("tcp_pose.z")] for i in range(len(found))]
    )
    asked = np.array([found[i]["action"].numpy() for i in range(len(found))])
    assert found.features["action"]["names"] == list(plugin.MOTION)
    print(f"actions: {np.unique(asked.round(3), axis=0).tolist()}")
    assert set(asked[:, 2].round(3)) <= {0.0, 0.5} and not asked[:, [0, 1, 3, 4, 5]].any()
    expected = 0.1 / 20 * asked[:, 2].sum()
    print(
        f"led by a SpaceMouse for {len(found)} ticks: {1e3 * np.ptp(height):.0f} mm up, {1e3 * expected:.0f} asked"
    )
    assert 0.8 < np.ptp(height) / expected < 1.1
    arm, again = make_robot_from_config(robot), []
    seen = arm.get_observation

    def observe() -> dict:
        again.append((found := seen())["tcp_pose.z"])
        return found

    arm.get_observation = observe
    lerobot_replay.make_robot_from_config = lambda _: arm
    what = lerobot_replay.DatasetReplayConfig(recorded.repo_id, 0, recorded.root, 20)
    lerobot_replay.replay(lerobot_replay.ReplayConfig(robot, what, play_sounds=False))
    apart = np.abs(np.array(again) - height).max()
    print(f"replayed from the same start: at most {1e3 * apart:.2f} mm apart")
    assert apart < 2e-3


def main() -> None:
    register_third_party_plugins()
    from lerobot_robot_touchgoal import TouchgoalRobotConfig

    columns = ["state", "tcp_pose", "wrench"]
    robot = make_robot_from_config(
        TouchgoalRobotConfig(cell=sys.argv[1], yes=True, columns=columns)
    )
    with robot:
        before = robot.get_observation()
        assert set(before) == set(robot.observation_features)
        for name, shape in robot.observation_features.items():
            assert shape is float or before[name].shape == shape, name
        still = dict.fromkeys(robot.action_features, 0.0) | {"gripper.target": 0.02}
        done = [robot.send_action(still | {"joint_1.delta": 0.01}) for _ in range(TICKS)]
        robot.send_action(still | {"joint_1.delta": 10.0})  # the filter takes it down
        for _ in range(TICKS):
            done.append(robot.send_action(still))
        after = robot.get_observation()
    moved = after["joint_1.pos"] - before["joint_1.pos"]
    sent = sum(action["joint_1.delta"] for action in done)
    print(
        f"joint 1: {moved:.3f} rad moved, {sent:.3f} sent; hand: {1e3 * after['gripper.pos']:.0f} mm"
    )
    turned = np.hypot(*(after[f"tcp_pose.{i}"] - before[f"tcp_pose.{i}"] for i in "xy"))
    assert 0.8 < turned / (moved * np.hypot(before["tcp_pose.x"], before["tcp_pose.y"])) < 1.2
    record_and_replay(sys.argv[1], Path(sys.argv[2]))
    assert 0.18 < moved < 0.35 and np.isclose(after["gripper.pos"], 0.02, atol=2e-3)


if __name__ == "__main__":
    main()
