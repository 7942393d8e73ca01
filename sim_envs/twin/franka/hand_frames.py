"""Frames of a Franka's hand on its flange, as its states report them."""

import numpy as np
from jaxtyping import Float

from touchgoal.control.safety.limits import FR3

Pose = Float[np.ndarray, "4 4"]


def flange_to_hand() -> Pose:
    """Return the pose of the hand's TCP on the flange (F_T_NE)."""
    T = np.eye(4)
    arm = FR3.arm
    c, s = np.cos(arm.hand_yaw), np.sin(arm.hand_yaw)
    T[:2, :2] = [[c, -s], [s, c]]
    T[2, 3] = FR3.tool.tcp_offset
    return T


def describe_hand(state: np.ndarray, ee: Pose, k: Pose) -> None:
    """Write the frames of hand, end effector and K into a state (`messages.ROBOT_STATE`)."""
    flange = flange_to_hand()
    state["F_T_NE"] = flange.T.ravel()
    state["F_T_EE"] = (flange @ ee).T.ravel()
    state["NE_T_EE"], state["EE_T_K"] = ee.T.ravel(), k.T.ravel()
    state["m_ee"], state["I_ee"] = 0.73, np.diag([0.001, 0.0025, 0.0017]).ravel()  # fr3.xml
    state["F_x_Cee"] = [-0.01, 0.0, 0.03]
