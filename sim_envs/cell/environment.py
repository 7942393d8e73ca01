"""What every task shares: a Gymnasium environment around the simulated cell."""

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from jaxtyping import Float, Float32, UInt8

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.motion.kinematics import Kinematics
from touchgoal.control.motion.rotations import fingers_down
from touchgoal.control.motion.tool import FRANKA_HAND
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.deployed_arm import DeployedArm
from touchgoal.sim_envs.cell.spaces import action_space, observation_space
from touchgoal.sim_envs.config import IDEAL_DEPLOYMENT, SETPOINT_PERIOD, EnvConfig, SceneConfig
from touchgoal.sim_envs.scene.build import ROBOTS, SIDES, arm_joints, build
from touchgoal.sim_envs.scene.contacts import SLIP_SPEED, ContactReader, PadContact
from touchgoal.sim_envs.scene.objects import Body
from touchgoal.sim_envs.scene.rendering import Renderer, open_renderer
from touchgoal.sim_envs.tactile.pad import TactileFrame, TactilePad
from touchgoal.sim_envs.tactile.sensor_instance import sample_instance

GRIPPER_MAX_WIDTH = FRANKA_HAND.stroke[1]  # m, to which experts open
DISTURBANCE_SECONDS = 0.5  # for which a disturbance keeps its direction
GRIPPER_SPEED = FRANKA_HAND.speed  # m/s of width
_FINGER_LAG = 1e-3  # m by which a finger may follow its set-point while it moves freely


class FrankaTactileEnv(gym.Env[dict[str, Any], np.ndarray], ABC):
    """An FR3 with two fingertip sensors at a table; a task adds objects, progress and success.

    Observations are a flat dict with the keys of `control/features.py`; truth (`truth.*`) is in
    `info`; that of the pads refers to the time the pictures were taken. The action is the joint change
    (rad) for this tick, added to the commanded joint positions, and the gripper width target (m). The
    gripper closes at its own speed and then holds with `grasp_force` N on each finger, as the Franka
    Hand's `grasp` does.
    """

    task: str  # the commands' and the episodes' name of it
    disturbance_rotation = 2.0  # rad of disturbance per m of it
    metadata = {"render_modes": ["rgb_array"], "render_fps": ft.CONTROL_HZ}  # noqa: RUF012

    def __init__(self, config: EnvConfig, render_mode: str | None = None) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UserError(f"render_mode is 'rgb_array' or none, not {render_mode!r}")
        self.config, self.render_mode = config, render_mode
        self.sensor = find_sensor(config.sensor)
        self.robot = ROBOTS[config.arm]
        self.n_joints = self.robot.arm.home.size
        self.kinematics = Kinematics(self.robot.arm, self.robot.tool.tcp_offset)
        self.action_space = self._limits = action_space(self.robot, config.control_hz)
        self.observation_space = observation_space(config, self.n_joints, self.sensor)
        self.grasp_force = 15.0
        self.bodies: list[Body] = []
        self._renderer: Renderer | None = None
        self._view_renderer: Renderer | None = None
        self._pads: list[TactilePad] = []

    # What a task defines.

    @abstractmethod
    def instruction(self) -> str:
        """The episode's task in words."""

    @abstractmethod
    def sample_episode(self, rng: np.random.Generator, options: dict[str, Any]) -> None:
        """Choose the episode: set `bodies` and `grasp_force`, UserError on a bad option."""

    @abstractmethod
    def add_task_objects(self, spec: mujoco.MjSpec) -> None:
        """Add the task's own parts to the scene."""

    @abstractmethod
    def place_objects(self, rng: np.random.Generator) -> None:
        """Put the objects where the episode starts."""

    @abstractmethod
    def evaluate(self) -> tuple[float, bool]:
        """Progress in [0, 1] and success after a tick."""

    # Gymnasium.

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the same seed and options give the same episode."""
        super().reset(seed=seed)
        rng = self.np_random
        self.sample_episode(rng, dict(options or {}))
        self._compile_scene(rng)
        self.place_objects(rng)
        self.command = self._command_before = self.start_joints(rng)
        self._disturbance_state = np.zeros(6)
        self._finger_target = self.robot.tool.stroke[1] / 2
        self.data.qpos[self.arm_positions] = self.command
        self.data.qpos[self._fingers] = self._finger_target
        self._ticks = 0
        self._deployed: DeployedArm | None = None
        self._let_settle()
        self._begin_deployment()
        self.evaluate()
        return self._observe(), self._info(0.0, False)

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One control tick; the reward is the tick's gain in progress."""
        action = np.asarray(action, dtype=np.float64)
        if action.shape != self.action_space.shape or not np.isfinite(action).all():
            size = self.n_joints + 1
            raise ValueError(f"an action is {size} finite numbers, not {action}")
        if self.config.disturbance > 0:
            action = action + np.append(self._disturbance(), 0.0)
        low, high = self._limits.low, self._limits.high
        action = np.clip(action, low, high)
        before = self._progress
        self._command_before = self.command
        self.begin_tick()
        if self._deployed:
            self._deployed.run_tick(action[:-1], action[-1])
        else:
            self._run_tick(action[:-1], action[-1], seconds=1 / self.config.control_hz)
        progress, success = self.end_tick()
        truncated = self._ticks >= self.config.max_seconds * self.config.control_hz
        # First, for the truth about the pads is of the moment at which their pictures were taken.
        observation = self._observe()
        ended = success or bool(self.failures())
        return observation, progress - before, ended, truncated, self._info(progress, success)

    def render(self) -> UInt8[np.ndarray, "h w 3"]:
        """A picture for people, from the side camera, 480 x 640."""
        if self._view_renderer is None:
            self._view_renderer = open_renderer(self.model, 480, 640)
        self._view_renderer.update_scene(self.data, "side")
        return self._view_renderer.render()

    def close(self) -> None:
        """Free the OpenGL contexts."""
        for renderer in (self._renderer, self._view_renderer):
            if renderer is not None:
                renderer.close()
        self._renderer, self._view_renderer = None, None

    # What experts and drivers use.

    def episode_info(self) -> dict[str, Any]:
        """What distinguishes the present episode: the object and how it is gripped."""
        body = self.bodies[0]
        return {
            "object": body.kind.name,
            "shape": body.kind.shape,
            "descriptions": list(body.kind.descriptions),
            "grasp_force": self.grasp_force,
            "mass": body.mass,
            "sensor": self.sensor.name,
        }

    def scene_layout(self) -> dict[str, list[float]]:
        """Positions in the base frame, as plain numbers: the object's pose (m, wxyz)."""
        return {"object": self.object_pose().tolist()}

    def scene(self, config: SceneConfig) -> mujoco.MjSpec:
        """The present episode's scene, built with these options."""
        spec = build(self.bodies, config)
        self.add_task_objects(spec)
        return spec

    def start_joints(self, rng: np.random.Generator) -> Float[np.ndarray, " n"]:
        """Joint positions with the open hand over the table, a little different each time."""
        position = np.array([0.45, 0.0, 0.26]) + rng.uniform(-0.03, 0.03, 3)
        return self.kinematics.solve_ik(
            position, fingers_down(rng.uniform(-0.2, 0.2)), self.robot.arm.home
        )

    def tactile_frames(self) -> list[TactileFrame]:
        """The last reading of the left and right sensor, with depth and contact mask."""
        return self._frames

    def tactile_pads(self) -> list[TactilePad]:
        """The left and the right sensor; none without touch."""
        return self._pads

    def pad_contacts(self) -> tuple[PadContact, PadContact]:
        """Exact wrench and slip of the left and right pad after the last tick."""
        return self._contacts

    # What the digital twin uses: the same cell, a physics step at a time.

    def begin_tick(self) -> None:
        """What happens in the cell by itself as a control tick begins; here nothing."""

    def step_physics(self, joints: np.ndarray, width: float, speed: float, steps: int = 1) -> None:
        """Physics steps under a servo set-point (rad), while the gripper goes to `width` (m).

        The gripper moves at `speed` (m/s of width) and presses with `grasp_force` at most.
        """
        travel = speed / 2 * steps * self.model.opt.timestep  # m of one finger
        self._finger_target += min(max(width / 2 - self._finger_target, -travel), travel)
        # No winding up while fingers are held open, or letting go would take as long again.
        deepest = self.width() / 2 - 2 * self.grasp_force / self._finger_stiffness - _FINGER_LAG
        self._finger_target = max(self._finger_target, deepest)
        self.model.actuator_forcerange[self._gripper, 0] = -2 * self.grasp_force
        self.data.ctrl[: self.n_joints] = joints
        self.data.ctrl[self._gripper] = self._finger_target
        mujoco.mj_step(self.model, self.data, nstep=steps)

    def update_contacts(self) -> None:
        """Bring contacts, poses and all else that follows from the state up to date with it."""
        mujoco.mj_forward(self.model, self.data)
        self._contacts, self._external = self._reader.read(self.data)

    def end_tick(self, begun: bool = True) -> tuple[float, bool]:
        """Progress in [0, 1] and success after a control tick; `update_contacts` first.

        The episode's clock stands still until it has `begun`.
        """
        self._ticks += begun
        return self.evaluate()

    def failures(self) -> list[str]:
        """Names of what has failed after the last tick: here at most over_force, as deployed."""
        return ["over_force"] if self._deployed and self._deployed.stopped else []

    def joints(self) -> tuple[np.ndarray, np.ndarray]:
        """Joint positions (rad) and velocities (rad/s)."""
        return self.data.qpos[self.arm_positions], self.data.qvel[self.arm_dofs]

    def joint_contact_torque(self) -> np.ndarray:
        """Torque (N m) on each joint of what touches the robot, from the last physics step."""
        return self._reader.joint_torque(self.data)[self.arm_dofs]

    def width(self) -> float:
        """Of the gripper, m."""
        left, right = self._fingers
        positions = self.data.qpos
        return float(positions[left] + positions[right])

    def width_target(self) -> float:
        """Where the gripper has been sent, m."""
        return 2 * self._finger_target

    def external_wrench(self) -> Float[np.ndarray, "6"]:
        """Force (N) and torque (N m) from outside at the TCP, base frame, at the last `update_contacts`."""
        return self._external

    def table_load(self) -> float:
        """Force (N) with which objects and robot press down on the table."""
        return self._reader.load(self.data, self.model.geom("table").id)

    def render_camera(self, camera: str) -> UInt8[np.ndarray, "h w 3"]:
        """What a camera sees, RGB."""
        assert self._renderer is not None
        self._renderer.update_scene(self.data, camera)
        return self._renderer.render()

    def read_tactile(self, side: int) -> TactileFrame:
        """What the left (0) or right (1) sensor shows; `update_contacts` first, keep to the order of time."""
        frame = self._pads[side].sense(self.data, self._contacts[side], self.np_random)
        change = self.config.light_change
        if self._ticks == 0 or not any(change):
            return frame
        lit = frame.image * (1 + np.array(change, np.float32))
        return replace(frame, image=np.rint(lit).clip(0, 255).astype(np.uint8))

    # Insides.

    def _let_settle(self) -> None:
        """Physics before the first observation: objects come to rest, the hand is open."""
        self._run_tick(np.zeros(self.n_joints), self.robot.tool.stroke[1], seconds=0.3)

    def _disturbance(self) -> Float[np.ndarray, " n"]:
        """Joint change (rad) that nobody commanded: a random walk of the hand's velocity."""
        tick = 1 / self.config.control_hz
        keep = np.exp(-tick / DISTURBANCE_SECONDS)
        self._disturbance_state = keep * self._disturbance_state + np.sqrt(
            1 - keep**2
        ) * self.np_random.normal(size=6)
        twist = (
            self.config.disturbance
            * np.repeat([1.0, self.disturbance_rotation], 3)
            * self._disturbance_state
        )
        return self.kinematics.joint_change(self.command, twist * tick)

    def _compile_scene(self, rng: np.random.Generator) -> None:
        self.close()
        self.model = model = self.scene(self.config).compile()
        self.data = mujoco.MjData(model)
        joints = [model.joint(name) for name in arm_joints(self.config.arm)]
        self.arm_positions = np.array([joint.qposadr[0] for joint in joints])
        self.arm_dofs = np.array([joint.dofadr[0] for joint in joints])
        self._fingers = [model.joint(f"finger_joint{i}").qposadr[0] for i in (1, 2)]
        self._gripper = model.actuator("gripper").id
        self._finger_stiffness = float(model.actuator_gainprm[self._gripper, 0])
        self._tcp = model.site("tcp").id
        self._reader = ContactReader(model)
        self._frames: list[TactileFrame] = []
        sensor, randomization = self.sensor, self.config.randomization
        self._pads = [
            TactilePad(
                model, side, sensor, sample_instance(sensor, rng, randomization), self.bodies
            )
            for side in (SIDES if self.config.tactile else ())
        ]
        if self.config.cameras:
            self._renderer = open_renderer(model, *self.config.camera_size)

    def _run_tick(self, delta: np.ndarray, width: float, seconds: float) -> None:
        """Physics for one tick, with set-points interpolated."""
        setpoints = round(seconds / SETPOINT_PERIOD)
        steps = round(SETPOINT_PERIOD / self.model.opt.timestep)
        start = self.command
        limits = self.model.actuator_ctrlrange[: self.n_joints]
        self.command = np.clip(start + delta, limits[:, 0], limits[:, 1])
        for k in range(1, setpoints + 1):
            joints = start + (self.command - start) * (k / setpoints)
            self.step_physics(joints, width, self.robot.tool.speed, steps)
        self.update_contacts()

    def _begin_deployment(self) -> None:
        """From here on the arm is as it is deployed, if it is to be."""
        between = self.config.resolved_deployment()
        if between != IDEAL_DEPLOYMENT:
            self._deployed = DeployedArm(self, between, self.np_random.spawn(1)[0])

    def _observe(self) -> Observation:
        command = {ft.COMMAND: self._read_command()}
        if self._deployed:
            return self._deployed.observation() | command
        return self.read_proprioception() | self.take_pictures() | command

    def _read_command(self) -> Float32[np.ndarray, " c"]:
        velocity = (self.command - self._command_before) * self.config.control_hz
        return np.concatenate([self.command, velocity]).astype(np.float32)

    def read_proprioception(self) -> Observation:
        """State, TCP pose and wrench as they are; `update_contacts` first."""
        data = self.data
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, data.site_xmat[self._tcp])
        values = {
            ft.STATE: np.concatenate([*self.joints(), [self.width()]]),
            ft.TCP_POSE: np.concatenate([data.site_xpos[self._tcp], quat]),
            ft.WRENCH: self._external,
        }
        return {key: value.astype(np.float32) for key, value in values.items()}

    def take_pictures(self) -> Observation:
        """What cameras and fingertips show now; `update_contacts` first, keep to the order of time."""
        pictures = {
            ft.IMAGE_PREFIX + camera: self.render_camera(camera) for camera in self.config.cameras
        }
        if self._pads:
            self._frames = [self.read_tactile(side) for side in range(2)]
            for key, frame in zip(ft.TACTILE, self._frames, strict=True):
                pictures[key] = frame.image
        return pictures

    def observed_contacts(self) -> tuple[PadContact, PadContact]:
        """The pads' contacts when the pictures of the last observation were taken."""
        return self._deployed.contacts if self._deployed else self._contacts

    @property
    def max_joint_step(self) -> Float[np.ndarray, " n"] | None:
        """Joint changes (rad) in a tick that a safety layer does not clamp; None: there is none."""
        clamped = self.config.resolved_deployment().tracker
        return self.robot.policy.velocity / self.config.control_hz if clamped else None

    @property
    def plan_ticks(self) -> int:
        """Control ticks by which a learned policy's plans come late in this episode."""
        return self._deployed.plan_ticks if self._deployed else 0

    def _info(self, progress: float, success: bool) -> dict[str, Any]:
        self._progress = progress
        pads = self.observed_contacts()
        wrench = np.concatenate([w for pad in pads for w in (pad.force, pad.torque)])
        return {
            ft.TRUTH_PAD_WRENCH: wrench.astype(np.float32),
            ft.TRUTH_CONTACT: np.array([pad.touching for pad in pads]),
            ft.TRUTH_SLIP: np.array([pad.slip_speed > SLIP_SPEED for pad in pads]),
            ft.TRUTH_OBJECT_POSE: self.object_pose().astype(np.float32),
            ft.TRUTH_PROGRESS: np.array([progress], np.float32),
            ft.TRUTH_SUCCESS: np.array([success]),
        }

    def object_pose(self, name: str = "object") -> Float[np.ndarray, "7"]:
        """Pose of an object in the base frame: m, quaternion wxyz."""
        return self.data.joint(name).qpos.copy()
