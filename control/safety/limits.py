"""Limits of a robot on its table: the maker's, and the tighter ones that a policy works inside."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from touchgoal.control.motion.arm_models import FR3_ARM, UR5E_ARM, ArmModel, JointLimits
from touchgoal.control.motion.kinematics import Kinematics
from touchgoal.control.motion.rotations import Vector3
from touchgoal.control.motion.tool import FRANKA_HAND, ROBOTIQ_2F85, Tool

Speeds = Float[np.ndarray, "*k joints"]
PerJoint = Float[np.ndarray, " joints"]


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the base frame (m)."""

    lower: Vector3
    upper: Vector3

    def contains(self, points: Float[np.ndarray, "*k 3"]) -> Bool[np.ndarray, "*k"]:
        """Return whether each point lies inside; False for NaN."""
        return np.all((points >= self.lower) & (points <= self.upper), axis=-1)

    def shrunk(self, by: float) -> "Box":
        """Return the box, smaller by `by` m at every side."""
        return Box(self.lower + by, self.upper - by)


@dataclass(frozen=True)
class RobotLimits:
    """One arm with its tool on its table."""

    arm: ArmModel  # geometry and the maker's limits
    tool: Tool  # gripper and fingertips
    # Boxes for the flange and for the corners of the fingertips.
    flange: Box
    fingertips: Box
    # Shares of the maker's limits that a policy may use.
    velocity_share: float = 0.2
    acceleration_share: float = 0.5
    margin: float = 0.1  # distance from the ends of the joints' ranges, rad
    max_step: float = 0.05  # rad, largest joint change in one control tick
    tracking: float = 0.2  # rad between command and arm that mean a blocked or lost arm
    tip_speed: float = 0.5  # m/s, of the flange and of each corner of the fingertips
    reserve: float = 0.6e-3  # m that commands stay inside the boxes: the 1 kHz stream cuts corners
    # External force at the TCP (N) and torque in a joint (Nm) that stop the arm.
    force: float = 15.0
    torque: float = 10.0
    indentation: float = 1.5e-3  # m of depth in a gel that stops the arm (`tactile.indentation`)

    def kinematics(self) -> Kinematics:
        """Return the kinematics of the arm with this tool."""
        return Kinematics(self.arm, self.tool.tcp_offset)

    @property
    def hardware(self) -> JointLimits:
        """Maker's limits; beyond them the controller stops the arm."""
        return self.arm.limits

    @property
    def interface(self) -> JointLimits:
        """Limits of the 1 kHz stream and of the arm's own moves: the maker's, less the margin."""
        return self.hardware.with_margin(self.margin)

    @property
    def policy(self) -> JointLimits:
        """Limits that a policy's commands are clamped to, tick by tick."""
        return self.interface.scaled(self.velocity_share, self.acceleration_share)


# Maker's limits: `motion/arm_models.py`. The values above are ours, below these:
# - margin 0.1 rad from the ends of the joints, as in DROID (Khazatsky et al., RSS 2024).
# - max_step 0.05 rad a tick, the order of LeRobot's `max_relative_target`.
# - acceleration_share: half, because the arm also brakes with it.
# - force 15 N and torque 10 Nm, below franky's reflex of 30 N and 20 Nm (libfranka,
#   `Robot::setCollisionBehavior`; its examples set 20 N and 20 Nm).
# - indentation: twice the deepest press into a Mini in FEATS (0.86 mm). In simulation a golf ball at
#   30 N, the least force of a Franka Hand (product manual), goes in by 1.2 mm, a pebble's edge by 2.
# - reserve: the stream was at most 0.45 mm beside the commands' path in an hour of
#   wild commands; a third more.
# - tip_speed: twice the reduced speed of ISO 10218-1, 0.25 m/s. Set that in the cell file on the first
#   day, when a person may be near.
# - tracking: our choice, without a source.

# The half of the table in front of the arm; the table's top is z = 0, and fingertips keep 5 mm off it.
_FLANGE = Box(np.array([0.15, -0.5, 0.12]), np.array([0.75, 0.5, 0.9]))
_FINGERTIPS = Box(np.array([0.15, -0.5, 0.005]), np.array([0.8, 0.5, 0.75]))

FR3 = RobotLimits(FR3_ARM, FRANKA_HAND, _FLANGE, _FINGERTIPS)
UR5E = RobotLimits(UR5E_ARM, ROBOTIQ_2F85, _FLANGE, _FINGERTIPS)


# Force ceilings of a task lie above what its demonstrations reach, below the arm's reflex.
_CEILING_MARGIN = 1.5  # factor on what demonstrations reach
_MOST = 28.0  # N: the arm is stopped before it stops itself, an FR3 at 30 N (`arms/franka.py`)
_LEVER = 0.6  # m: farthest that a hand over the table is from the axis of a joint that lifts it


@dataclass(frozen=True)
class TaskForces:
    """Peaks over a task's successful demonstrations, seeds from 30000.

    `force` is on the hand, N; `indentation` in a gel, m, as `control.tactile.indentation` measures
    it.
    """

    force: float
    indentation: float

    @property
    def force_ceiling(self) -> float:
        """Force (N) on the hand above which a run of this task is stopped."""
        return min(_CEILING_MARGIN * self.force, _MOST)

    @property
    def torque_ceiling(self) -> float:
        """Torque (Nm) that this force causes in a joint, so that neither limit comes first."""
        return _LEVER * self.force_ceiling

    @property
    def indentation_ceiling(self) -> float:
        """Depth (m) in a gel that stops a run; `deepest_readable` bounds it for a sensor."""
        return _CEILING_MARGIN * self.indentation


# 60 episodes of pick-place, and 60 with --feedback; 29 of the maze with a disturbance of 4 mm/s for
# the force, and six without for the indentation.
TASK_FORCES: dict[str, TaskForces] = {
    "pick-place": TaskForces(force=16.5, indentation=2.1e-3),
    "bead-maze": TaskForces(force=17.9, indentation=1.15e-3),
}


def max_stoppable_speed(gap: Speeds, acceleration: PerJoint, dt: float) -> Speeds:
    """Return the highest speed (rad/s) for this tick that still brakes to rest within `gap` (rad).

    Exact for a command that changes once a tick of `dt` s: braking takes `acceleration * dt` off
    the speed. In these units speed u with n = floor(u) travels (n + 1) u - n (n + 1) / 2; this
    inverts it. Zero for no gap. Keeping to it is always possible: one tick of braking from an
    allowed speed is allowed again.
    """
    unit = acceleration * dt
    g = np.maximum(gap, 0) / (unit * dt)
    n = np.floor((np.sqrt(1 + 8 * g) - 1) / 2)
    return unit * (g + n * (n + 1) / 2) / (n + 1)


def braked_velocity(velocity: Speeds, acceleration: PerJoint, dt: float) -> Speeds:
    """Return the velocity (rad/s) after one tick of braking, each joint by itself."""
    return velocity - np.clip(velocity, -acceleration * dt, acceleration * dt)
