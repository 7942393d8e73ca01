"""The simulated cell as a Gymnasium environment, shared by all tasks."""

from abc import abstractmethod
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Float, UInt8

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.motion.rotations import fingers_down
from touchgoal.control.safety.limits import TASK_FORCES
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.deployed_arm import DeployedArm
from touchgoal.sim_envs.cell.hardware import SimulatedHardware
from touchgoal.sim_envs.config import (
    SETPOINT_PERIOD,
    USUAL_CAMERA,
    CameraPlacement,
    EnvConfig,
    with_options,
)
from touchgoal.sim_envs.scene.contacts import SLIP_SPEED, PadContact
from touchgoal.sim_envs.scene.rendering import open_renderer
from touchgoal.sim_envs.scene.variety import CALIBRATION_ERROR, measured_placement
from touchgoal.sim_envs.tactile.pad import TactileFrame

DISTURBANCE_SECONDS = 0.5  # s for which a disturbance keeps its direction


class FrankaTactileEnv(SimulatedHardware, gym.Env[dict[str, Any], np.ndarray]):
    """An arm with two fingertip sensors at a table; a task adds objects, progress and success.

    ## Action space

    `Box(n + 1)`; n is 7 for an FR3, 6 for a UR5e.

    | index | meaning | range | unit |
    |---|---|---|---|
    | 0 to n - 1 | joint change for this tick | ±speed limit / `control_hz` | rad |
    | n | target width of the gripper | 0 to the stroke (0.08) | m |

    Joint changes add up to the commanded positions. The gripper goes to the width at its own speed,
    then holds with `grasp_force` N a finger.

    ## Observation space

    `Dict`; keys, shapes and units as in `control/features.py`, poses and wrenches in the base
    frame.

    | key | shape | meaning | unit |
    |---|---|---|---|
    | `observation.state` | (2n + 1,) | joints, joint velocities, gripper width | rad, rad/s, m |
    | `observation.command` | (2n,) | commanded joint positions and velocities | rad, rad/s |
    | `observation.tcp_pose` | (7,) | tool centre point: position, quaternion wxyz | m |
    | `observation.wrench` | (6,) | force and torque on the robot at the TCP | N, Nm |
    | `observation.age` | (1,) | of its oldest measurement | s |
    | `observation.images.<camera>` | (h, w, 3) | RGB, one for each of `cameras` | 0 to 255 |
    | `observation.images.tactile_left` | (h, w, 3) | RGB, left fingertip | 0 to 255 |
    | `observation.images.tactile_right` | (h, w, 3) | RGB, right fingertip | 0 to 255 |

    ## Reward

    Progress of this tick minus progress of the tick before. Progress is in [0, 1], and 1 on
    success: an episode's rewards sum to its last progress.

    ## Episode end

    Terminated: success, or a failure (`failures()`). `over_force`: the force on the hand is above
    the task's ceiling (`control/safety/limits.py`), at which `deploy` stops the arm.
    Truncated: after `max_seconds`.

    ## Info

    `truth.*` of `control/features.py`, known to a simulator alone: pad wrenches, contact, slip,
    object pose, progress, success. Truth about the pads is as old as the tactile images.
    """

    task: str  # its name in commands and episodes
    disturbance_rotation = 2.0  # rad of disturbance per m
    start_width: float | None = None  # m, of the hand at first; None: as wide as it opens
    settle_seconds = 0.3  # s in which objects come to rest before the first observation
    metadata = {"render_modes": ["rgb_array"], "render_fps": ft.CONTROL_HZ}  # noqa: RUF012
    default_config: EnvConfig = EnvConfig()

    def __init__(
        self, config: EnvConfig | None = None, render_mode: str | None = None, **options: Any
    ) -> None:
        """Take a config, options by name that override its fields, or both."""
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UserError(f"render_mode is 'rgb_array' or none, not {render_mode!r}")
        config = with_options(config or self.default_config, options)
        forces = TASK_FORCES.get(self.task)
        super().__init__(config, forces.force_ceiling if forces else np.inf)
        self.render_mode = render_mode
        step = self.robot.hardware.velocity / config.control_hz
        self.action_space = self._limits = gym.spaces.Box(
            np.append(-step, 0.0).astype(np.float32),
            np.append(step, self.robot.tool.stroke[1]).astype(np.float32),
            dtype=np.float32,
        )
        self.observation_space = self._observation_space()

    def _observation_space(self) -> gym.spaces.Dict:
        features, config = ft.features_of(self.n_joints), self.config
        spaces: dict[str, gym.Space[Any]] = {
            key: gym.spaces.Box(-np.inf, np.inf, features[key].shape, np.float32)
            for key in (ft.STATE, ft.COMMAND, ft.TCP_POSE, ft.WRENCH, ft.AGE)
        }
        sizes = {ft.IMAGE_PREFIX + camera: config.camera_size for camera in config.cameras}
        if config.tactile:
            sizes |= dict.fromkeys(ft.TACTILE, self.sensor.image_shape)
        for key, size in sizes.items():
            spaces[key] = gym.spaces.Box(0, 255, (*size, 3), np.uint8)
        return gym.spaces.Dict(spaces)

    # What a task defines.

    @abstractmethod
    def instruction(self) -> str:
        """Return the episode's task in words."""

    @abstractmethod
    def sample_episode(self, rng: np.random.Generator, options: dict[str, Any]) -> None:
        """Draw the episode: set `bodies` and `grasp_force`; raise UserError on a bad option."""

    @abstractmethod
    def place_objects(self, rng: np.random.Generator) -> None:
        """Put the objects where the episode starts."""

    @abstractmethod
    def evaluate(self) -> tuple[float, bool]:
        """Return progress in [0, 1] and success after a tick."""

    # Gymnasium.

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the same seed and options give the same episode."""
        super().reset(seed=seed)
        rng = self.np_random
        self.sample_episode(rng, dict(options or {}))
        self.compile_scene(rng)
        self.place_objects(rng)
        self.command = self._command_before = self.start_joints(rng)
        self._disturbance_state = np.zeros(6)
        self._finger_target = (self.start_width or self.robot.tool.stroke[1]) / 2
        self.data.qpos[self.arm_positions] = self.command
        self.data.qpos[self._fingers] = self._finger_target
        self._force.reset()
        self._let_settle()
        self._begin_episode()
        self.evaluate()
        return self._observe(), self._info(0.0, False)

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Run one control tick; the reward is its gain in progress.

        gymnasium.error.ResetNeeded: no episode has begun. ValueError: the action is not n + 1
        finite numbers.
        """
        self._require_episode("step")
        action = np.asarray(action, dtype=np.float64)
        if action.shape != self.action_space.shape or not np.isfinite(action).all():
            size = self.n_joints + 1
            raise ValueError(f"an action is {size} finite numbers, not {action}")
        if self.config.disturbance > 0:
            action = action + np.append(self._disturbance(), self._width_disturbance())
        action = np.clip(action, self._limits.low, self._limits.high)
        before = self._progress
        self._command_before = self.command
        self.begin_tick()
        if self._deployed:
            self.command = self._deployed.run_tick(action[:-1], action[-1])
        else:
            self._run_tick(action[:-1], action[-1], seconds=1 / self.config.control_hz)
        progress, success = self.end_tick()
        truncated = self._ticks >= self.config.max_seconds * self.config.control_hz
        observation = self._observe()  # before `_info`, whose truth is of these images
        failed = bool(self.failures())
        success = success and not failed
        info = self._info(progress, success)
        ends = failed or (success and self.config.ends_by_success)
        return observation, progress - before, ends, truncated, info

    def render(self) -> UInt8[np.ndarray, "h w 3"]:
        """Render the side camera, 480 x 640 RGB; raises ResetNeeded before the first episode."""
        self._require_episode("render")
        if self._view_renderer is None:
            self._view_renderer = open_renderer(self.model, 480, 640)
        self._view_renderer.update_scene(self.data, "side")
        return self._view_renderer.render()

    # For experts and drivers.

    def episode_info(self) -> dict[str, Any]:
        """Return what distinguishes this episode: the object and how it is gripped."""
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
        """Return positions in the base frame as plain numbers: the object's pose (m, wxyz)."""
        return {"object": self.object_pose().tolist()}

    def start_joints(self, rng: np.random.Generator) -> Float[np.ndarray, " n"]:
        """Draw joint positions (rad) that hold the open hand over the table."""
        position = np.array([0.45, 0.0, 0.26]) + rng.uniform(-0.03, 0.03, 3)
        return self.kinematics.solve_ik(
            position, fingers_down(rng.uniform(-0.2, 0.2)), self.robot.arm.home
        )

    # For the digital twin: the same cell, a physics step at a time.

    def begin_tick(self) -> None:
        """Prepare a control tick; a task may move its fixtures here."""

    def end_tick(self, begun: bool = True) -> tuple[float, bool]:
        """Return progress in [0, 1] and success after a control tick; `update_contacts` first.

        The episode's clock does not run until it has `begun`.
        """
        self._ticks += begun
        self._force.check(self._external)
        return self.evaluate()

    def failures(self) -> list[str]:
        """Return the names of what has failed so far: here at most `over_force`."""
        return ["over_force"] if self._force.exceeded else []

    # Internal.

    def _require_episode(self, method: str) -> None:
        if not hasattr(self, "command"):
            raise gym.error.ResetNeeded(f"{method} needs an episode; call reset() first")

    def read_tactile(self, side: int) -> TactileFrame:
        """Read a sensor; its light changes after the episode's first tick if the config says so."""
        frame, change = super().read_tactile(side), self.config.light_change
        if self._ticks == 0 or not any(change):
            return frame
        lit = frame.image * (1 + np.array(change, np.float32))
        return replace(frame, image=np.rint(lit).clip(0, 255).astype(np.uint8))

    def _let_settle(self) -> None:
        """Run physics until objects rest, with the hand open, before the first observation."""
        self._run_tick(np.zeros(self.n_joints), 2 * self._finger_target, self.settle_seconds)

    def _disturbance(self) -> Float[np.ndarray, " n"]:
        """Draw a joint change (rad): a random walk of the hand's velocity."""
        tick = 1 / self.config.control_hz
        keep = np.exp(-tick / DISTURBANCE_SECONDS)
        noise, state = self.np_random.normal(size=6), self._disturbance_state
        self._disturbance_state = keep * state + np.sqrt(1 - keep**2) * noise
        size = self.config.disturbance * np.repeat([1.0, self.disturbance_rotation], 3)
        return self.kinematics.joint_change(self.command, size * self._disturbance_state * tick)

    def _width_disturbance(self) -> float:
        """Draw a change of the target width (m); most tasks leave the width alone."""
        return 0.0

    def _run_tick(self, delta: np.ndarray, width: float, seconds: float) -> None:
        """Run a tick with interpolated set-points; end it where the force is too high."""
        setpoints = round(seconds / SETPOINT_PERIOD)
        steps = round(SETPOINT_PERIOD / self.model.opt.timestep)
        start = self.command
        self.command = np.clip(start + delta, *self.setpoint_range.T)
        speed = self.robot.tool.speed
        for joints in np.linspace(start, self.command, setpoints + 1)[1:]:
            self.step_physics(joints, width, speed, steps)
            if self.monitor_force(SETPOINT_PERIOD):
                break
        self.update_contacts()

    def _begin_episode(self) -> None:
        """Start the episode's clock, its force monitor and, as deployed, its `DeployedArm`."""
        self._ticks = 0
        self._force.reset()
        self._deployed: DeployedArm | None = None
        if self.config.as_deployed:
            rng = self.np_random.spawn(1)[0]
            self._deployed = DeployedArm(self, self.command.copy(), self.config.deployment, rng)

    def _observe(self) -> Observation:
        velocity = (self.command - self._command_before) * self.config.control_hz
        command = {ft.COMMAND: np.concatenate([self.command, velocity]).astype(np.float32)}
        if self._deployed:
            observation = self._deployed.observation()
            self._force.check(observation[ft.WRENCH])  # as `deploy` does
            return observation | command
        age = {ft.AGE: np.zeros(1, np.float32)}
        return self.read_proprioception() | self.take_images() | command | age

    def observed_contacts(self) -> tuple[PadContact, PadContact]:
        """Return the pads' contacts at the time of the last observation's images."""
        return self._deployed.contacts if self._deployed else self._contacts

    @property
    def max_joint_step(self) -> Float[np.ndarray, " n"] | None:
        """Largest joint change (rad) that the safety layer lets through; None without one."""
        config = self.config
        return self.robot.policy.velocity / config.control_hz if config.as_deployed else None

    def calibrated_camera(self) -> CameraPlacement:
        """Return where the front camera is, base frame.

        As deployed, one that is not where it usually is is 5 mm and 1 degree (RMS) from there, alike
        for the same seed, as after a calibration.
        """
        if self.config.front_camera is None:
            return USUAL_CAMERA
        drawn: Any = self.np_random.bit_generator.seed_seq  # of the last seed given to reset
        rng = np.random.default_rng(drawn.entropy)
        off = CALIBRATION_ERROR if self.config.as_deployed else (0.0, 0.0)
        return measured_placement(self.model, self.data, off, rng)

    @property
    def plan_ticks(self) -> int:
        """Control ticks by which a learned policy's plans are late in this episode."""
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
