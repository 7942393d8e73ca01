"""The one simulated cell: arm, hand, fingertips and cameras at a table, without any task."""

from abc import ABC, abstractmethod

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.motion.tool import FRANKA_HAND
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.sim_envs.cell.estimated_wrench import ForceMonitor
from touchgoal.sim_envs.config import EnvConfig, SceneConfig
from touchgoal.sim_envs.scene.build import ROBOTS, SIDES, arm_joints, build, quaternion
from touchgoal.sim_envs.scene.contacts import ContactReader, PadContact
from touchgoal.sim_envs.scene.lighting import UsualLight
from touchgoal.sim_envs.scene.objects import Body
from touchgoal.sim_envs.scene.rendering import Renderer, open_renderer
from touchgoal.sim_envs.tactile.pad import TactileFrame, TactilePad
from touchgoal.sim_envs.tactile.sensor_instance import sample_instance

GRIPPER_MAX_WIDTH = FRANKA_HAND.stroke[1]  # m, to which experts open
GRIPPER_SPEED = FRANKA_HAND.speed  # m/s of width
_FINGER_LAG = 1e-3  # m by which a freely moving finger lags its set-point, at most

_RENDERERS = 2  # OpenGL contexts that are kept
_NO_FORCE = np.zeros(3)
_LEAST_TORQUE = 2.0  # Nm; 20 N on the hand over the table, from any side, load some joint with more


class SimulatedHardware(ABC):
    """Physics and sensors of the cell, a physics step at a time."""

    def __init__(self, config: EnvConfig, force_ceiling: float) -> None:
        """`force_ceiling`: N on the hand."""
        self.config, self._force = config, ForceMonitor(force_ceiling)
        self.sensor = find_sensor(config.sensor)
        self.robot = ROBOTS[config.arm]
        self.n_joints = self.robot.arm.home.size
        self.kinematics = self.robot.kinematics()
        self.grasp_force = 15.0  # N of each finger
        self.bodies: list[Body] = []  # objects of the scene, the task's first
        self._renderers: list[Renderer] = []  # the one in use first
        self._view_renderer: Renderer | None = None
        self.pads: list[TactilePad] = []  # left and right sensor; empty without `tactile`

    @abstractmethod
    def add_task_objects(self, spec: mujoco.MjSpec) -> None:
        """Add the task's own parts to the scene."""

    def scene(self, config: SceneConfig) -> mujoco.MjSpec:
        """Build this episode's scene with other scene options."""
        spec = build(self.bodies, config)
        self.add_task_objects(spec)
        return spec

    def step_physics(self, joints: np.ndarray, width: float, speed: float, steps: int = 1) -> None:
        """Run physics steps under a servo set-point (rad).

        The gripper goes to `width` (m) at `speed` (m/s of width), pressing with `grasp_force` at
        most.
        """
        travel = speed / 2 * steps * self._timestep  # m of one finger
        target = self._finger_target
        target += min(max(width / 2 - target, -travel), travel)
        # No wind-up while an object holds the fingers open: it would delay letting go.
        deepest = self.width() / 2 - 2 * self.grasp_force / self._finger_stiffness - _FINGER_LAG
        self._finger_target = max(target, deepest)
        self._gripper_force[0] = -2 * self.grasp_force
        self._arm_control[:] = joints
        self._gripper_control[0] = self._finger_target
        mujoco.mj_step(self.model, self.data, nstep=steps)

    @property
    def setpoint_range(self) -> Float[np.ndarray, "n 2"]:
        """Lowest and highest set-point (rad) of each joint's servo."""
        return self.model.actuator_ctrlrange[: self.n_joints]

    def release_setpoints(self) -> None:
        """Take set-points beyond `setpoint_range`, to which feed-forward leads; the drive checks."""
        self.model.actuator_ctrllimited[: self.n_joints] = 0

    def update_contacts(self) -> None:
        """Recompute contacts and poses from the state."""
        mujoco.mj_forward(self.model, self.data)
        self._contacts, self._external = self._reader.read(self.data)

    def joints(self) -> tuple[np.ndarray, np.ndarray]:
        """Return joint positions (rad) and velocities (rad/s)."""
        return self.data.qpos[self.arm_positions], self.data.qvel[self.arm_dofs]

    def joint_contact_torque(self) -> np.ndarray:
        """Return the contact torque (Nm) on each joint in the last physics step."""
        return self._reader.joint_torque(self.data)[self.arm_dofs]

    def width(self) -> float:
        """Return the gripper's width, m."""
        return sum(self._finger_positions.tolist())

    def width_target(self) -> float:
        """Return the width that the gripper was sent to, m."""
        return 2 * self._finger_target

    def external_wrench(self) -> Float[np.ndarray, "6"]:
        """Return the contact wrench (N, Nm) on the robot at the TCP, base frame."""
        return self._external

    def contact_force(self) -> Float[np.ndarray, "3"]:
        """Return the robot's contact force (N) in the last step, base frame; 0 if small.

        To save time, contacts are read only if the torque on some joint exceeds `_LEAST_TORQUE`.
        """
        if max(map(abs, self._constraint_torque.tolist())) < _LEAST_TORQUE:
            return _NO_FORCE
        return self._reader.external_force(self.data)

    def monitor_force(self, seconds: float) -> bool:
        """Update the force monitor `seconds` after the last call; return whether it trips."""
        self._force.update(self.contact_force(), seconds)
        return self._force.exceeded

    def pad_contacts(self) -> tuple[PadContact, PadContact]:
        """Return the exact wrench and slip of both pads at the last `update_contacts`."""
        return self._contacts

    def table_load(self) -> float:
        """Return the force (N) that presses down on the table."""
        return self._reader.load(self.data, self.model.geom("table").id)

    def object_pose(self, name: str = "object") -> Float[np.ndarray, "7"]:
        """Return an object's pose in the base frame: m, quaternion wxyz."""
        return self.data.joint(name).qpos.copy()

    def render_camera(self, camera: str) -> UInt8[np.ndarray, "h w 3"]:
        """Render a camera, RGB."""
        renderer = self._renderers[0]
        renderer.update_scene(self.data, camera)
        return renderer.render()

    def read_tactile(self, side: int) -> TactileFrame:
        """Read the left (0) or right (1) sensor; `update_contacts` first, in order of time."""
        return self.pads[side].sense(self.data, self._contacts[side], self._noise_rng)

    def read_proprioception(self) -> Observation:
        """Return state, TCP pose and wrench without delay; `update_contacts` first."""
        data = self.data
        values = {
            ft.STATE: np.concatenate([*self.joints(), [self.width()]]),
            ft.TCP_POSE: np.concatenate(
                [data.site_xpos[self._tcp], quaternion(data.site_xmat[self._tcp])]
            ),
            ft.WRENCH: self._external,
        }
        return {key: value.astype(np.float32) for key, value in values.items()}

    def take_images(self) -> Observation:
        """Render cameras and read fingertips; `update_contacts` first, in order of time."""
        images = {
            ft.IMAGE_PREFIX + camera: self.render_camera(camera) for camera in self.config.cameras
        }
        if self.pads:
            # their last readings, with depth and contact mask
            self.tactile_frames = [self.read_tactile(side) for side in range(2)]
            for key, frame in zip(ft.TACTILE, self.tactile_frames, strict=True):
                images[key] = frame.image
        return images

    def close(self) -> None:
        """Free the OpenGL contexts."""
        self._close_view()
        while self._renderers:
            self._renderers.pop().close()

    def _show(self, model: mujoco.MjModel) -> None:
        """Put the renderer for a model first: one that can show it, else a new one.

        A new one and its first image take 17 ms. Two are kept, because objects with and without a
        mesh of their own take turns.
        """
        fits = next((r for r in self._renderers if r.show(model)), None)
        if fits is None:
            fits = open_renderer(model, *self.config.camera_size)
        self._renderers = [fits, *(r for r in self._renderers if r is not fits)]
        while len(self._renderers) > _RENDERERS:
            self._renderers.pop().close()

    def _close_view(self) -> None:
        if self._view_renderer is not None:
            self._view_renderer.close()
        self._view_renderer = None

    def compile_scene(self, rng: np.random.Generator) -> None:
        """Compile the scene of `bodies`; `rng` draws sensors and, later, camera noise."""
        self._close_view()
        self._noise_rng = rng
        self.model = model = self.scene(self.config).compile()
        UsualLight.of(model).change(model, self.config.lighting)
        self.data = mujoco.MjData(model)
        joints = [model.joint(name) for name in arm_joints(self.config.arm)]
        self.arm_positions = np.array([joint.qposadr[0] for joint in joints])
        self.arm_dofs = np.array([joint.dofadr[0] for joint in joints])
        self._fingers = [model.joint(f"finger_joint{i}").qposadr[0] for i in (1, 2)]
        gripper = model.actuator("gripper").id
        self._finger_stiffness = float(model.actuator_gainprm[gripper, 0])
        self._timestep = model.opt.timestep
        # Views, for what every set-point reads or writes.
        self._gripper_force = model.actuator_forcerange[gripper]
        self._arm_control = self.data.ctrl[: self.n_joints]
        self._gripper_control = self.data.ctrl[gripper : gripper + 1]
        left, right = self._fingers
        self._finger_positions = self.data.qpos[left : right + 1 : right - left]
        first = self.arm_dofs[0]
        self._constraint_torque = self.data.qfrc_constraint[first : first + self.n_joints]
        self._tcp = model.site("tcp").id
        self._reader = ContactReader(model)
        self.tactile_frames: list[TactileFrame] = []
        sensor, randomization = self.sensor, self.config.randomization
        self.pads = [
            TactilePad(
                model, side, sensor, sample_instance(sensor, rng, randomization), self.bodies
            )
            for side in (SIDES if self.config.tactile else ())
        ]
        if self.config.cameras:
            self._show(model)
