"""The simulated cell in 1 kHz steps, with set-points and gripper commands from outside."""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from touchgoal.control.motion.tracker import SERVO_DAMPING
from touchgoal.control.safety.limits import braked_velocity
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.environment import FrankaTactileEnv
from touchgoal.sim_envs.cell.estimated_wrench import WrenchError
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.scene.build import GRIPPER_MAX_FORCE

DT = 1e-3  # s, of the Franka control interface and of the physics
AT_REST = 0.01  # rad/s
_ASIDE = 0.25, 0.4  # m: place on the table for an object that is taken away
# s, first order, our choice: how fast the arm's estimate of external torque follows, and how fast
# an arm that was hit gives way.
_TORQUE_FILTER_TIME = _YIELD_TIME = 0.02
# rad/s^2 of a reflex, four times that of motions. An instant stop would saturate a wrist's
# torque and make it chatter.
_REFLEX_DECELERATION = 40.0

_ERROR_STREAM = 1  # random stream of the wrench error, beside the seed
_NO_FORCE = NO_OFFSET = np.zeros(3)

Joints = Float[np.ndarray, " n"]


@dataclass
class GripperCommand:
    """Target width (m), speed (m/s of width) and force of each finger (N)."""

    width: float
    speed: float
    force: float


@dataclass
class WorstCase:
    """Extremes since the episode began, for tests that inject faults."""

    excess: float = 0.0  # rad beyond the maker's joint range
    speed: float = 0.0  # share of the maker's joint speed
    force: float = 0.0  # N on the robot from outside, checked once a control tick


class SimulatedCell:
    """A task's cell, advanced a millisecond at a time and judged once a control tick.

    The arm is position controlled with velocity feed-forward, so that it follows its set-point
    without the servo's lag.
    """

    def __init__(self, env: FrankaTactileEnv, seed: int, wrench_error: bool = True) -> None:
        self.env, self._errs = env, wrench_error
        self.reset(seed)

    def reset(self, seed: int, options: dict[str, Any] | None = None) -> None:
        """Begin an episode: arm and objects jump to where it starts, the hand is open."""
        env = self.env
        env.reset(seed=seed, options=options)
        n = env.n_joints
        model = env.model
        env.release_setpoints()
        self._scratch = mujoco.MjData(model)
        self._hand, self._tcp = model.body("hand").id, model.site("tcp").id
        self._braking: Joints | None = None
        self._yielding = False
        self._nudge_force, self._nudged_until = np.zeros(3), 0.0
        # time, steps: s and ms since the episode began, simulated
        self.time, self.steps = 0.0, 0
        # q_d, dq_d: their set-points; tau_ext: torque (N m) on each joint from outside, filtered
        self.q_d, self.dq_d, self.tau_ext = env.command.copy(), np.zeros(n), np.zeros(n)
        self.q, self.dq = env.joints()  # measured joint positions (rad), velocities (rad/s)
        # A stream of its own: the episode's other draws do not depend on it.
        rng = np.random.default_rng([seed, _ERROR_STREAM])
        self._error = WrenchError(rng) if self._errs else None
        # N, N m, by which the arm's estimate of the wrench on the hand is wrong
        self.wrench_error = self._error.read() if self._error else np.zeros(6)
        self.gripper_command = GripperCommand(
            env.width_target(), env.robot.tool.speed, env.grasp_force
        )
        self.worst = WorstCase()
        self.least_width = 0.0  # width (m) below which the fingers jam; 0: none
        self.progress, self.success, self.failures = 0.0, False, set[str]()
        self._grasp_begun = False  # the episode's clock waits for the first grasp
        self._rest_since = 0.0
        self._note_extremes()

    # What arms and grippers command.

    def set_target(self, q_d: Joints, dq_d: Joints) -> None:
        """Command joint positions `q_d` (rad), moving with `dq_d` (rad/s)."""
        self._braking, self._yielding = None, False
        self.q_d, self.dq_d = q_d, dq_d

    def brake(self, acceleration: Joints) -> None:
        """Bring the set-point to rest, by rad/s^2 for each joint."""
        self._braking, self._yielding = acceleration, False

    def give_way(self) -> None:
        """Stop here, as hard as a reflex does, and then give way to what presses."""
        self.brake(np.full_like(self.dq, _REFLEX_DECELERATION))
        self.q_d, self.dq_d, self._yielding = self.q.copy(), self.dq.copy(), True

    def command_gripper(self, width: float, speed: float, force: float) -> None:
        """Send the gripper to `width` (m) at `speed` (m/s), pressing with `force` (N) a finger."""
        tool = self.env.robot.tool
        width = float(np.clip(width, max(tool.stroke[0], self.least_width), tool.stroke[1]))
        self._grasp_begun |= width < self.gripper_command.width
        self.gripper_command = GripperCommand(
            width, min(speed, tool.speed), min(force, GRIPPER_MAX_FORCE / 2)
        )

    def nudge(self, force: Float[np.ndarray, "3"], seconds: float) -> None:
        """Push the hand with a force (N, base frame) for a while, as a person might."""
        self._nudge_force, self._nudged_until = force, self.time + seconds

    def take_object(self) -> None:
        """Put the object of pick-and-place aside, wherever it is; UserError in another task."""
        if not isinstance(self.env, PickPlace):
            raise UserError("there is no object to take in this task")
        body = self.env.bodies[0]
        joint = self.env.data.joint(body.name)
        joint.qpos[:3] = *_ASIDE, body.rest_height + 0.001
        joint.qvel[:] = 0.0

    # Time.

    def step(self) -> None:
        """Advance by a millisecond."""
        env = self.env
        tick = round(1 / (env.config.control_hz * DT))
        if self.steps % tick == 0:
            env.begin_tick()
        if self._braking is not None:
            self.dq_d = braked_velocity(self.dq_d, self._braking, DT)
            given_way = (DT / _YIELD_TIME) * (self.q - self.q_d) if self._yielding else 0.0
            self.q_d = self.q_d + DT * self.dq_d + given_way
        pushed = self._apply_nudge()
        env.grasp_force = self.gripper_command.force
        joints, gripper = self.q_d + SERVO_DAMPING * self.dq_d, self.gripper_command
        env.step_physics(joints, gripper.width, gripper.speed)
        self.steps += 1
        self.time = self.steps * DT
        self.q, self.dq = env.joints()
        now = env.joint_contact_torque() + pushed
        self.tau_ext = self.tau_ext + (DT / _TORQUE_FILTER_TIME) * (now - self.tau_ext)
        self._note_extremes()
        if self._error:
            self._error.update(DT)
            self.wrench_error = self._error.read()
        if self.steps % tick == 0:
            env.update_contacts()
            self.progress, self.success = env.end_tick(self._grasp_begun)
            self.failures.update(env.failures())
            force = float(np.linalg.norm(env.external_wrench()[:3]))
            self.worst.force = max(self.worst.force, force)

    @property
    def moving(self) -> bool:
        """Whether any joint moves."""
        return bool(np.abs(self.dq).max() > AT_REST)

    @property
    def joint_torque(self) -> Joints:
        """Torque (N m) of each joint's drive, gravity compensation included."""
        data, dofs = self.env.data, self.env.arm_dofs
        return data.qfrc_actuator[dofs] + data.qfrc_gravcomp[dofs]

    def kinematics(
        self, q: Joints, offset: Float[np.ndarray, "3"] = NO_OFFSET
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"], Float[np.ndarray, "6 n"]]:
        """Return position (m), rotation and Jacobian of a point `offset` m from the TCP."""
        env, data = self.env, self._scratch
        data.qpos[env.arm_positions] = q
        mujoco.mj_kinematics(env.model, data)
        mujoco.mj_comPos(env.model, data)
        R = data.site_xmat[self._tcp].reshape(3, 3).copy()
        point = data.site_xpos[self._tcp] + R @ offset
        jacobian = np.empty((6, env.model.nv))
        mujoco.mj_jac(env.model, data, jacobian[:3], jacobian[3:], point, self._hand)
        return point, R, jacobian.take(env.arm_dofs, axis=1)

    def truth(self) -> dict[str, Any]:
        """Return ground truth, and the state of arm and gripper, as plain numbers."""
        return {
            "time": self.time,
            "instruction": self.env.instruction(),
            "progress": float(self.progress),
            "success": bool(self.success),
            "failures": sorted(self.failures),
            "layout": self.env.scene_layout(),
            "pad_forces": [pad.normal_force for pad in self.env.pad_contacts()],
            "episode_info": self.env.episode_info(),
            "q": self.q.tolist(),
            "dq": self.dq.tolist(),
            "q_d": self.q_d.tolist(),
            "width": self.env.width(),
            "rest": self.time - self._rest_since if not self.moving else 0.0,
            "worst": vars(self.worst),
        }

    # Internal.

    def _apply_nudge(self) -> Joints:
        """Apply the nudge; return its torque (N m) on each joint."""
        env = self.env
        force = self._nudge_force if self.time < self._nudged_until else _NO_FORCE
        env.data.xfrc_applied[self._hand, :3] = force
        if not force.any():
            return np.zeros(env.n_joints)
        jacobian = np.zeros((3, env.model.nv))
        mujoco.mj_jac(env.model, env.data, jacobian, None, env.data.xipos[self._hand], self._hand)
        return force @ jacobian[:, env.arm_dofs]

    def _note_extremes(self) -> None:
        limits, worst = self.env.robot.hardware, self.worst
        # excess, speed: as of `worst`, now
        self.excess = float(np.maximum(limits.lower - self.q, self.q - limits.upper).max())
        self.speed = float((np.abs(self.dq) / limits.velocity).max())
        worst.excess, worst.speed = max(worst.excess, self.excess), max(worst.speed, self.speed)
        if self.moving:
            self._rest_since = self.time
