"""Swing a twin's arm through lerobot's robot interface; run by lerobot_plugins.py in lerobot's Python.

python tests/interop/lerobot_arm.py CELL.json
"""

import sys

import numpy as np
from lerobot.robots.utils import make_robot_from_config
from lerobot.utils.import_utils import register_third_party_plugins

TICKS = 20


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
    assert 0.18 < moved < 0.35 and np.isclose(after["gripper.pos"], 0.02, atol=2e-3)


if __name__ == "__main__":
    main()
