"""The makers' arm models: links, and limits of range, speed, acceleration and jerk.

SI units; joint order from the base outwards; every number with its source.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

Joints = Float[np.ndarray, "n"]


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
        """Return limits with a range `margin` rad narrower at both ends."""
        return replace(self, lower=self.lower + margin, upper=self.upper - margin)

    def scaled(self, velocity: float, acceleration: float) -> "JointLimits":
        """Return limits at a share of the speed, and of acceleration and jerk."""
        return replace(
            self,
            velocity=velocity * self.velocity,
            acceleration=acceleration * self.acceleration,
            jerk=acceleration * self.jerk,
        )

    def speed_range(
        self, q: Float[np.ndarray, "*k n"]
    ) -> tuple[Float[np.ndarray, "*k n"], Float[np.ndarray, "*k n"]]:
        """Return the lowest (negative) and highest joint speed (rad/s) at joint positions `q`."""
        ceiling = np.broadcast_to(self.velocity, q.shape)
        if self.taper is None:
            return -ceiling, ceiling
        t = self.taper
        up = np.sqrt(np.maximum(t.gain * (t.upper - q), 0)) - t.offset
        down = np.sqrt(np.maximum(t.gain * (q - t.lower), 0)) - t.offset
        return -np.clip(down, 0, ceiling), np.clip(up, 0, ceiling)


@dataclass(frozen=True)
class ArmModel:
    """A serial arm whose joints each turn about their own z axis."""

    name: str  # for messages
    # origin (m) and rotation about x (rad) of each joint's frame in the one before it
    links: tuple[tuple[tuple[float, float, float], float], ...]
    flange_offset: float  # m from the last joint to the flange, along its z axis
    hand_yaw: float  # rad by which a hand is turned on the flange
    limits: JointLimits  # the maker's; beyond them the controller stops the arm
    home: Joints  # rad, over the table, fingers down, elbow where people expect it


FR3_ARM = ArmModel(
    "FR3",
    links=(  # Franka's FR3 description, as shipped in franky-sim's fr3.xml.
        ((0.0, 0.0, 0.333), 0.0),
        ((0.0, 0.0, 0.0), -np.pi / 2),
        ((0.0, -0.316, 0.0), np.pi / 2),
        ((0.0825, 0.0, 0.0), np.pi / 2),
        ((-0.0825, 0.384, 0.0), -np.pi / 2),
        ((0.0, 0.0, 0.0), np.pi / 2),
        ((0.088, 0.0, 0.0), np.pi / 2),
    ),
    flange_offset=0.107,
    hand_yaw=-np.pi / 4,
    # Franka's FCI documentation, "Robot and interface specifications", "Limits for Franka Research 3"
    # (frankarobotics.github.io/docs/robot_specifications.html): range of franka_description's
    # joint_limits.yaml; speed, acceleration, jerk and taper as in libfranka's rate_limiting.h, where
    # gain is twice the deceleration.
    limits=JointLimits(
        lower=np.array([-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159]),
        upper=np.array([2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159]),
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
    home=np.array([0.0, -0.3, 0.0, -2.2, 0.0, 1.9, np.pi / 4]),
)

_UR5E_UPPER = np.array([2.0, 2.0, 1.0, 2.0, 2.0, 2.0]) * np.pi  # the elbow would hit the arm

UR5E_ARM = ArmModel(
    "UR5e",
    # Universal Robots' Denavit-Hartenberg table (article 45257, e-Series 5.1): a, d and alpha of
    # joint i place the frame of joint i + 1. Base frame: the controller's, not ROS's.
    links=(
        ((0.0, 0.0, 0.0), 0.0),
        ((0.0, 0.0, 0.1625), np.pi / 2),
        ((-0.425, 0.0, 0.0), 0.0),
        ((-0.3922, 0.0, 0.0), 0.0),
        ((0.0, 0.0, 0.1333), np.pi / 2),
        ((0.0, 0.0, 0.0997), -np.pi / 2),
    ),
    flange_offset=0.0996,
    hand_yaw=0.0,
    # Range and speed: Universal Robots' UR5e technical specifications (360 deg, 180 deg/s), as in
    # Universal_Robots_ROS2_Description ur5e/joint_limits.yaml. UR limits torques, not acceleration; 5
    # is the value of the MoveIt configuration of UR's driver for ROS 2. Jerk, which the controller does
    # not limit either, is our choice: full acceleration in 20 ms; servoj's shortest lookahead_time is
    # 30 ms (URScript manual).
    limits=JointLimits(
        lower=-_UR5E_UPPER,
        upper=_UR5E_UPPER,
        velocity=np.full(6, 3.14),
        acceleration=np.full(6, 5.0),
        jerk=np.full(6, 250.0),
    ),
    home=np.array([0.0, -1.9, -1.8, 3.7 - 1.5 * np.pi, np.pi / 2, -np.pi / 2]),
)
