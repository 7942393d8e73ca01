"""Franka FR3 through franky-control, in a child process.

Commands are joint velocities that each last 100 ms: if the child dies or stalls, the arm comes to
rest by itself. franky's own 1 kHz loop smooths them. A proportional term towards the commanded
position keeps the integrated velocities from drifting.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from touchgoal.control.arms.client_libraries import FRANKY
from touchgoal.control.arms.streaming import ArmClient, shift_wrench
from touchgoal.control.interfaces import ArmReading, Joints
from touchgoal.control.motion.arm_models import JointLimits

if TYPE_CHECKING:
    import franky

RATE = 200.0  # Hz of velocity commands
STATE_TIMEOUT = 0.5  # s; libfranka itself gives up after 1 s
_COMMAND_MS = 100  # duration of each command
_POSITION_GAIN = 10.0  # 1/s towards the commanded position
_SHARE = 0.9  # share of franky's limits for the stream; the rest is for the proportional term
# Nm and N: franky's defaults for libfranka's setCollisionBehavior, above RobotLimits.force.
_TORQUE_REFLEX, _FORCE_REFLEX = 20.0, 30.0


class FrankaClient(ArmClient):
    """One FR3 with FCI switched on in Desk, in the driver's process."""

    def _connect(self, recover: bool) -> JointLimits:
        self._franky = client = FRANKY.load("franky")
        self._aborted = ""
        model = self.config.robot
        self._kinematics = model.kinematics()
        # No real-time kernel is asked for: firmware 5.9 and later does without.
        self._robot: franky.Robot = client.Robot(
            self.config.address,
            default_torque_threshold=_TORQUE_REFLEX,
            default_force_threshold=_FORCE_REFLEX,
            realtime_config=client.RealtimeConfig.Ignore,
        )
        if recover and self._robot.state.robot_mode == client.RobotMode.Reflex:
            self._robot.recover_from_errors()
        return self._limits(self._robot)

    def _limits(self, robot: "franky.Robot") -> JointLimits:
        """Set franky's limits and return the stream's.

        franky's defaults are the Panda's: some exceed the FR3's, and those below cannot be raised.
        The controller differentiates rounded positions, so acceleration and jerk stay 1 and 2 %
        lower.
        """
        hardware, interface = self.config.robot.hardware, self.config.robot.interface
        wanted = (
            (robot.joint_velocity_limit, hardware.velocity),
            (robot.joint_acceleration_limit, 0.99 * hardware.acceleration),
            (robot.joint_jerk_limit, 0.98 * hardware.jerk),
        )
        for limit, value in wanted:
            limit.set(np.minimum(value, limit.max))
        self._ceiling = robot.joint_velocity_limit.get()
        used = (_SHARE * limit.get() for limit, _ in wanted)
        return JointLimits(interface.lower, interface.upper, *used, taper=interface.taper)

    def _measure(self) -> ArmReading:
        robot = self._robot
        try:
            robot.poll_motion()  # raises the error that ended a motion
        except self._franky.ControlException as error:
            self._aborted = " ".join(str(error).split())
        state = robot.state
        self._commanded = state.q_d
        contact = (state.O_T_EE * state.EE_T_K).translation
        tcp, _ = self._kinematics.forward(state.q)
        flange = state.O_T_EE * state.F_T_EE.inverse  # whatever end effector Desk knows
        offset = self.config.robot.tool.tcp_offset
        return ArmReading(
            q=state.q,
            velocity=state.dq,
            wrench=shift_wrench(wrench_on_robot(state.O_F_ext_hat_K), contact, tcp),
            # tau_J minus what the model expects of it (robot_state.h): what the robot pushes with.
            torque=-np.asarray(state.tau_ext_hat_filtered),
            fault=self._fault(state),
            stamp=self._stamped(state.time.to_sec()),
            time=state.time.to_sec(),
            tcp=(flange * self._franky.Affine([0.0, 0.0, offset])).translation,
        )

    def _fault(self, state: "franky.RobotState") -> str:
        mode = self._franky.RobotMode
        if state.robot_mode == mode.Reflex:
            return f"reflex ({_errors(state)}): clear the cause, then: touchgoal arm recover"
        if state.robot_mode == mode.UserStopped:
            return "user stop: release the activation device, then: touchgoal arm recover"
        if state.robot_mode not in (mode.Idle, mode.Move):
            return f"the arm is in mode {state.robot_mode.name}: set it to execution in Desk"
        return f"{self._aborted}; recover the arm" if self._aborted else ""

    def _send(self, q: Joints, velocity: Joints) -> None:
        wanted = velocity + _POSITION_GAIN * (q - self._commanded)
        motion = self._franky.JointVelocityMotion(
            np.clip(wanted, -self._ceiling, self._ceiling), self._franky.Duration(_COMMAND_MS)
        )
        try:
            self._robot.move(motion, asynchronous=True)
        except self._franky.ControlException as error:
            self._aborted = " ".join(str(error).split())  # the next measurement says why

    def _halt(self) -> None:
        if self._robot.is_in_control:
            self._robot.move(self._franky.JointVelocityStopMotion(), asynchronous=True)

    def _disconnect(self) -> None:
        del self._robot


def wrench_on_robot(estimate: Float[np.ndarray, "6"]) -> Float[np.ndarray, "6"]:
    """Return libfranka's O_F_ext_hat_K (N, Nm) as a wrench of the environment on the robot.

    libfranka's robot_state.h: "Forces applied by the robot to the environment are positive, while
    forces applied by the environment on the robot are negative. Becomes [0,0,0,0,0,0] when near or in
    a singularity." The result is NaN there: unknown.
    """
    return np.full(6, np.nan) if not np.any(estimate) else -np.asarray(estimate)


def _errors(state: "franky.RobotState") -> str:
    errors = state.current_errors
    return ", ".join(n for n in dir(errors) if getattr(errors, n) is True) or "unnamed"
