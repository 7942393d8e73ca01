"""What a robot on its table may do: the maker's limits, and the tighter ones a policy works inside."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from touchgoal.control.motion.arm_models import FR3_ARM, UR5E_ARM, ArmModel, JointLimits
from touchgoal.control.motion.rotations import Vector3
from touchgoal.control.motion.tool import FRANKA_HAND, ROBOTIQ_2F85, Tool


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the base frame (m)."""

    lower: Vector3
    upper: Vector3

    def contains(self, points: Float[np.ndarray, "*k 3"]) -> Bool[np.ndarray, "*k"]:
        """Whether each point lies inside; False for what is not a number."""
        return np.all((points >= self.lower) & (points <= self.upper), axis=-1)

    def shrunk(self, by: float) -> "Box":
        """The same box, smaller by so many m at every side."""
        return Box(self.lower + by, self.upper - by)


@dataclass(frozen=True)
class RobotLimits:
    """One arm with its tool on its table.

    Attributes:
        arm: its geometry and its maker's limits.
        tool: what it carries.
        velocity_share, acceleration_share: what a policy may use of them.
        margin: rad kept from the ends of the joints' ranges.
        max_step: rad, largest joint change in one control tick.
        tracking: rad between commanded and measured joints that mean a blocked or lost arm.
        flange, fingertips: where the flange and the corners of the fingertips may be.
        reserve: m that commands keep inside these boxes, so that the 1 kHz stream, which cuts the
            corners of their path, keeps inside, too.
        tip_speed: m/s, of the flange and of each of those corners.
        force, torque: N and Nm from outside at the TCP and in a joint, below the reflex.
        indentation: m that anything may press into a gel, as seen (`control.tactile.indentation`).
    """

    arm: ArmModel
    tool: Tool
    flange: Box
    fingertips: Box
    velocity_share: float = 0.2
    acceleration_share: float = 0.5
    margin: float = 0.1
    max_step: float = 0.05
    tracking: float = 0.2
    tip_speed: float = 0.5
    reserve: float = 0.6e-3
    force: float = 15.0
    torque: float = 10.0
    indentation: float = 1.5e-3

    @property
    def hardware(self) -> JointLimits:
        """The maker's limits; beyond them the controller stops the arm."""
        return self.arm.limits

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
# acceleration, not 30 %, because it also brakes. Tracking: our choice, without a source. Indentation: twice
# what FEATS pressed into a Mini (0.86 mm); simulated, a golf ball at 30 N, the least that a Franka
# Hand grasps with, goes in by 1.2 mm, a pebble's edge by 2 mm. Compare it with your sensor's sheet.

# Reserve: the stream was at most 0.45 mm beside the commands' path in an hour (touchgoal benchmark
# sent-stream); a third more.

# Speed of the fingertips: twice ISO 10218-1's reduced speed of 0.25 m/s, at which a person may be near;
# set that in the cell file on the first day.

# The half of the table in front of the arm; the table's top is z = 0, and fingertips keep 5 mm off it.
_FLANGE = Box(np.array([0.15, -0.5, 0.12]), np.array([0.75, 0.5, 0.9]))
_FINGERTIPS = Box(np.array([0.15, -0.5, 0.005]), np.array([0.8, 0.5, 0.75]))

FR3 = RobotLimits(FR3_ARM, FRANKA_HAND, _FLANGE, _FINGERTIPS)
UR5E = RobotLimits(UR5E_ARM, ROBOTIQ_2F85, _FLANGE, _FINGERTIPS)
