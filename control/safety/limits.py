"""What each arm may do: the maker's limits, and the tighter ones a policy works inside.

SI units; joint order from the base outwards; every number with its source.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from touchgoal.control.motion import kinematics
from touchgoal.control.motion.kinematics import GELSIGHT_TCP, ArmModel

Joints = Float[np.ndarray, "n"]
Vector3 = Float[np.ndarray, "3"]


@dataclass(frozen=True)
class SpeedTaper:
    """Speed shrinking near a joint's ends: |v| <= sqrt(gain (end - q)) - offset (rad, s)."""

    offset: Joints
    gain: Joints
    lower: Joints
    upper: Joints


@dataclass(frozen=True)
class JointLimits:
    """Range (rad), and highest speed (rad/s), acceleration (rad/s^2) and jerk (rad/s^3)."""

    lower: Joints
    upper: Joints
    velocity: Joints
    acceleration: Joints
    jerk: Joints
    taper: SpeedTaper | None = None

    def with_margin(self, margin: float) -> "JointLimits":
        """The same with a range `margin` rad narrower at both ends."""
        return JointLimits(
            self.lower + margin,
            self.upper - margin,
            self.velocity,
            self.acceleration,
            self.jerk,
            self.taper,
        )

    def scaled(self, velocity: float, acceleration: float) -> "JointLimits":
        """The same range at a share of the speed, and of acceleration and jerk."""
        return JointLimits(
            self.lower,
            self.upper,
            velocity * self.velocity,
            acceleration * self.acceleration,
            acceleration * self.jerk,
            self.taper,
        )

    def speed_range(
        self, q: Float[np.ndarray, "*k n"]
    ) -> tuple[Float[np.ndarray, "*k n"], Float[np.ndarray, "*k n"]]:
        """Lowest (negative) and highest joint speed (rad/s) at joint positions `q`."""
        ceiling = np.broadcast_to(self.velocity, q.shape)
        if self.taper is None:
            return -ceiling, ceiling
        t = self.taper
        up = np.sqrt(np.maximum(t.gain * (t.upper - q), 0)) - t.offset
        down = np.sqrt(np.maximum(t.gain * (q - t.lower), 0)) - t.offset
        return -np.clip(down, 0, ceiling), np.clip(up, 0, ceiling)


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the base frame (m)."""

    lower: Vector3
    upper: Vector3

    def contains(self, points: Float[np.ndarray, "*k 3"]) -> Bool[np.ndarray, "*k"]:
        """Whether each point lies inside; False for what is not a number."""
        return np.all((points >= self.lower) & (points <= self.upper), axis=-1)


@dataclass(frozen=True)
class RobotLimits:
    """One robot model on its table.

    Attributes:
        arm: geometry.
        hardware: the maker's limits; beyond them the controller stops the arm.
        velocity_share, acceleration_share: what a policy may use of them.
        margin: rad kept from the ends of the joints' ranges.
        max_step: rad, largest joint change in one control tick.
        tracking: rad between commanded and measured joints that mean a blocked or lost arm.
        flange, fingertips: where the flange and the fingers' outer lower edges may be.
        finger_edges: those edges in the hand frame (m).
        force, torque: N and Nm from outside at the TCP and in a joint, below the reflex.
        touch: m that anything may press into a gel, as seen (`control.touch.indentation`).
        stroke: m, least and largest width that a gripper is asked for.
    """

    arm: ArmModel
    hardware: JointLimits
    flange: Box
    fingertips: Box
    velocity_share: float = 0.2
    acceleration_share: float = 0.5
    margin: float = 0.1
    max_step: float = 0.05
    tracking: float = 0.2
    force: float = 15.0
    torque: float = 10.0
    touch: float = 1.5e-3
    stroke: tuple[float, float] = (0.0, 0.08)  # of the Franka Hand

    # Franka Hand fully open (80 mm) with GelSight Minis: outer faces 28.3 mm behind the gels, lower
    # edges half of 32.5 mm below the sensor's centre (GelSight STEP file), rounded outwards.
    finger_edges: tuple[tuple[float, float, float], ...] = (
        (0.0, 0.07, GELSIGHT_TCP + 0.0165),
        (0.0, -0.07, GELSIGHT_TCP + 0.0165),
    )

    @property
    def interface(self) -> JointLimits:
        """What the 1 kHz command and the arm's own moves stay within: the maker's, less a margin."""
        return self.hardware.with_margin(self.margin)

    @property
    def policy(self) -> JointLimits:
        """What a policy's commands are clamped to, tick by tick."""
        return self.interface.scaled(self.velocity_share, self.acceleration_share)


# Shares, margin, step, forces: proposals of shared/research/drivers.md 6, after what DROID (0.1 rad
# margin, 20 N) and LeRobot (0.05 per step) do; Franka's reflex is set at 20 N and above. Half the
# acceleration, not 30 %, because it also brakes. Tracking: our choice, without a source. Touch: twice
# what FEATS pressed into a Mini (0.86 mm); simulated, a golf ball at 30 N, the least that a Franka
# Hand grasps with, goes in by 1.2 mm, a pebble's edge by 2 mm. Compare it with your sensor's sheet.

FR3 = RobotLimits(
    arm=kinematics.FR3_ARM,
    # Range: franka_description joint_limits.yaml. Speed, acceleration, jerk, taper: libfranka
    # rate_limiting.h ("Limits for Franka Research 3"), where gain is twice the deceleration.
    hardware=JointLimits(
        lower=kinematics.FR3_LOWER,
        upper=kinematics.FR3_UPPER,
        velocity=np.array([2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26]),
        acceleration=np.full(7, 10.0),
        jerk=np.full(7, 5000.0),
        taper=SpeedTaper(
            offset=np.array([0.30, 0.20, 0.20, 0.30, 0.35, 0.35, 0.35]),
            gain=np.array([12.0, 5.17, 7.0, 8.0, 34.0, 11.0, 34.0]),
            lower=np.array([-2.7501, -1.7918, -2.9065, -3.0481, -2.8101, 0.54092, -3.0196]),
            upper=np.array([2.7501, 1.7918, 2.9065, -0.1458, 2.8101, 4.5205, 3.0196]),
        ),
    ),
    # The half of the table in front of the arm; the table's top is z = 0.
    flange=Box(np.array([0.15, -0.5, 0.12]), np.array([0.75, 0.5, 0.9])),
    fingertips=Box(np.array([0.15, -0.5, 0.0]), np.array([0.8, 0.5, 0.75])),
)

UR5E = RobotLimits(
    arm=kinematics.UR5E_ARM,
    # Range and speed: Universal_Robots_ROS2_Description ur5e/joint_limits.yaml (180 deg/s).
    # Acceleration is unpublished; 3.14 is our choice (drivers.md 6). So is jerk, which the controller
    # does not enforce: full acceleration in 20 ms; its lookahead at the shortest is 30.
    hardware=JointLimits(
        lower=kinematics.UR5E_LOWER,
        upper=kinematics.UR5E_UPPER,
        velocity=np.full(6, 3.14),
        acceleration=np.full(6, 3.14),
        jerk=np.full(6, 157.0),
    ),
    flange=Box(np.array([0.15, -0.5, 0.12]), np.array([0.75, 0.5, 0.9])),
    fingertips=Box(np.array([0.15, -0.5, 0.0]), np.array([0.8, 0.5, 0.75])),
)
