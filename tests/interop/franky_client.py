"""franky against the address given: joint, Cartesian and velocity motions, the hand.

It answers with one line of JSON; `run.py` judges it.
"""

import json
import sys

import franky
import numpy as np


def main(address: str) -> None:
    """All of it on one arm."""
    robot = franky.Robot(address, realtime_config=franky.RealtimeConfig.Ignore)
    robot.recover_from_errors()
    # franky's own limits are the Panda's.
    robot.joint_velocity_limit.set([2, 1, 1.5, 1.25, 2.1, 1.5, 2.1])
    robot.joint_acceleration_limit.set([9.9, 7.5, 9.9, 9.9, 9.9, 9.9, 9.9])
    robot.joint_jerk_limit.set([4900, 3700, 4900, 4900, 4900, 4900, 4900])
    robot.relative_dynamics_factor = 0.3
    said: dict[str, object] = {}
    start = np.array(robot.state.q_d)
    robot.move(franky.JointMotion((start + 0.1).tolist()))
    said["joint"] = (np.array(robot.state.q_d) - start).tolist()
    pose = robot.state.O_T_EE.translation
    down = franky.Affine([0.0, 0.0, 0.03])
    robot.move(franky.CartesianMotion(down, franky.ReferenceType.Relative))
    said["cartesian"] = (np.array(robot.state.O_T_EE.translation) - pose).tolist()
    before = np.array(robot.state.q_d)
    robot.move(franky.JointVelocityMotion([0.1] + [0.0] * 6, franky.Duration(1000)))
    said["velocity"] = (np.array(robot.state.q_d) - before).tolist()
    robot.move(franky.JointVelocityStopMotion())
    robot.move(franky.JointMotion(start.tolist()))
    hand = franky.Gripper(address)
    hand.move(0.05, 0.05)
    said["width"] = hand.width
    said["air"] = hand.grasp(0.02, 0.05, 20.0, 0.001, 0.001)
    hand.move(0.08, 0.05)
    said["gravity"] = float(np.abs(robot.model.gravity(robot.state)).max())
    print(json.dumps(said))


if __name__ == "__main__":
    main(sys.argv[1])
