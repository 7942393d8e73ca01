"""The arm's state in its wire format, updated in place every millisecond."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from touchgoal.control.safety.limits import FR3
from touchgoal.sim_envs.cell.simulated_cell import SimulatedCell
from touchgoal.sim_envs.twin.franka import limits, messages
from touchgoal.sim_envs.twin.franka.messages import RobotMode

OTHER = 3  # controller of a motion that is not the client's own

Pose = Float[np.ndarray, "4 4"]


@dataclass
class Motion:
    """A client's motion, from its Move command to the answer that ends it."""

    request: messages.Request
    # generator, controller: numbers of the interface
    generator: int
    controller: int
    begun: bool = False  # whether the client has sent a set-point
    lost: int = 0  # milliseconds since the last one


class ArmState:
    """State message (`messages.ROBOT_STATE`)."""

    def __init__(self) -> None:
        records = np.zeros(1, messages.ROBOT_STATE)
        self.record = records.reshape(())
        names = records.dtype.names or ()
        self.fields = {  # views of the record's fields by name, ten times as fast to write
            name: records[name][0] if records[name].ndim > 1 else records[name] for name in names
        }
        self.fields["O_ddP_O"][:] = 0.0, 0.0, -9.81  # robot_state.h: "hard-coded for now"
        self._error = ""

    def write_hand(self, ee: Pose, k: Pose) -> None:
        """Write the frames of hand, end effector (NE_T_EE) and K (EE_T_K)."""
        flange = np.eye(4)  # F_T_NE
        c, s = np.cos(FR3.arm.hand_yaw), np.sin(FR3.arm.hand_yaw)
        flange[:2, :2] = [[c, -s], [s, c]]
        flange[2, 3] = FR3.tool.tcp_offset
        record = self.record
        record["F_T_NE"], record["F_T_EE"] = flange.T.ravel(), (flange @ ee).T.ravel()
        record["NE_T_EE"], record["EE_T_K"] = ee.T.ravel(), k.T.ravel()
        record["m_ee"], record["I_ee"] = 0.73, np.diag([0.001, 0.0025, 0.0017]).ravel()  # fr3.xml
        record["F_x_Cee"] = [-0.01, 0.0, 0.03]

    def write_joints(self, cell: SimulatedCell, ddq_d: limits.Joints, nonsense: bool) -> None:
        """Write measured and commanded joints; with `nonsense` joint speeds are NaN."""
        fields = self.fields
        fields["q"][:] = fields["theta"][:] = q = cell.q
        fields["dtheta"][:] = dq = cell.dq
        fields["dq"][:] = np.nan if nonsense else dq
        fields["q_d"][:] = q_d = cell.q_d
        fields["dq_d"][:], fields["ddq_d"][:] = cell.dq_d, ddq_d
        fields["tau_J"][:] = cell.joint_torque
        fields["elbow"][:] = q[2], np.sign(q[3])
        fields["elbow_d"][:] = fields["elbow_c"][:] = q_d[2], np.sign(q_d[3])

    def write_tcp(
        self,
        cell: SimulatedCell,
        ee: Pose,
        now: Pose,
        wrench: limits.Wrench,
        contact: limits.Contact,
    ) -> None:
        """Write the end effector's pose, its target, and the wrench on it."""
        fields = self.fields
        fields["O_T_EE"][:] = now.T.ravel()
        target, jacobian = end_effector(cell, ee, cell.q_d)
        fields["O_T_EE_d"][:] = fields["O_T_EE_c"][:] = target.T.ravel()
        fields["O_dP_EE_d"][:] = fields["O_dP_EE_c"][:] = jacobian @ cell.dq_d
        # The maker's sign: the robot's wrench on the environment; `cell` has the opposite.
        sent = limits.estimate_sent(wrench, jacobian)
        fields["tau_ext_hat_filtered"][:] = -cell.tau_ext
        fields["O_F_ext_hat_K"][:] = sent
        fields["K_F_ext_hat_K"][:] = (sent.reshape(2, 3) @ now[:3, :3]).ravel()
        for name, value in vars(contact).items():
            fields[name][:] = value

    def write_mode(self, mode: int, error: str, motion: Motion | None, success_rate: float) -> None:
        """Write mode, errors and control command success rate."""
        fields = self.fields
        if error != self._error:
            self._error = error
            fields["errors"][:] = [name == error for name in messages.ERRORS]
            fields["reflex_reason"][:] = fields["errors"]
        fields["robot_mode"][:] = RobotMode.MOVE if motion else mode
        fields["controller_mode"][:] = motion.controller if motion else OTHER
        # A state counts generators from 1: 0 is idle.
        fields["motion_generator_mode"][:] = motion.generator + 1 if motion else 0
        fields["control_command_success_rate"][:] = success_rate if motion else 0.0


def end_effector(
    cell: SimulatedCell, ee: Pose, q: limits.Joints
) -> tuple[Pose, Float[np.ndarray, "6 7"]]:
    """Return pose and Jacobian of the end effector, which a client may have moved off the TCP."""
    position, R, jacobian = cell.kinematics(q, ee[:3, 3])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R @ ee[:3, :3], position
    return pose, jacobian
