"""Fragile carry: hold a rod of unknown friction and strength neither too loosely nor too hard."""

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from touchgoal.control.motion.rotations import fingers_down
from touchgoal.sim_envs.cell.environment import DISTURBANCE_SECONDS, FrankaTactileEnv
from touchgoal.sim_envs.config import FragileCarryConfig, FragileCarryReset, with_options
from touchgoal.sim_envs.scene.build import GRIPPER_MAX_FORCE, VISUAL_GROUP
from touchgoal.sim_envs.scene.objects import HARD, Body, Material, ObjectKind, Texture

START, GOAL = np.array([0.5, -0.05]), np.array([0.5, 0.05])  # m: the rod's middle on its rests
RADIUS, HALF_LENGTH = 0.008, 0.042  # m, of the rod without its round ends
REST_HEIGHT = 0.030  # m
LEVEL = REST_HEIGHT + RADIUS  # m, of the rod's middle on its rests
GRIP_OFFSET = 0.004  # m from the rod's middle to where it is gripped: it also turns
GRIP_HEIGHT = -0.002  # m of the TCP above the rod's middle: room on the pad for a rod that slides
# m of target width per N: drive, two gels and contact, measured
WIDTH_PER_FORCE = 0.318e-3

_TURN_FACTOR = 1.2  # force that also stops turning over the force that stops sliding, measured
_TORSION_RADIUS = 0.004  # m: radius of the contact patch, over which friction resists a turn
_REST_SIZE = (0.004, 0.014, REST_HEIGHT / 2)  # m, half extents
_REST_OFFSET = 0.042  # m from the rod's middle to its rests
_LIFTED = 0.015  # m above the rests that counts as carried
_CLEAR = 0.005  # m above the rests, where nothing but the hand holds the rod
_TOLERANCE = 0.015  # m from the goal
_DROP = 0.012  # m of sliding along the pads after which the rod is lost
_MAX_TILT = np.radians(12)
_LEVEL_TILT, _LEVEL_HEIGHT, _STILL_SPEED = np.radians(3), 1.5e-3, 0.01  # rad, m, m/s
_CRUSH_TICKS = 2  # successive control ticks above the crush force that break the rod
_TUG_SECONDS = 0.3
_HOLD_FORCE = 1.0, 8.0  # N of each finger that just holds the rod, drawn log-uniformly
_CRUSH_RATIO = 2.5  # force of a finger that crushes the rod, relative to the one that just holds it
_TUG = 0.35  # force of the tug on the carried rod, relative to its weight
_TUG_ARM = 0.010  # m: farthest place of the tug from the rod's middle
_SQUEEZE_DISTURBANCE = 60.0  # share of the force that holds, per m/s of disturbance

_CARD = Material(Texture.SMOOTH, 0.0, 1e-3, HARD, 0.5, (0.85, 0.72, 0.5, 1.0))
_ROD = ObjectKind("rod", "capsule", _CARD, ("a smooth rod", "a straight smooth round rod"))


def width_for(force: float) -> float:
    """Return the target width (m) at which each finger presses on the rod with a force (N)."""
    return 2 * RADIUS - WIDTH_PER_FORCE * force


class FragileCarry(FrankaTactileEnv):
    """Lift the rod, around which the hand starts open, and put it down level on the other rests.

    The force that holds the rod varies eightfold, and the force that crushes it with it: a full
    glass and an empty paper cup. All rods look alike, weigh about the same and are equally wide;
    one that is held too loosely slides and turns in the hand. On its way something tugs at it.
    The hand's width target sets the force: `WIDTH_PER_FORCE`.

    `reset` takes the options of `FragileCarryReset`.

    Success: the rod, once lifted, lies level and at rest on the other rests for a quarter of a
    second. Progress: 0 until it is lifted, to 0.9 on its way, 1 on success. An episode also ends
    when the rod is dropped, tilted by 12 degrees, or crushed.
    """

    task = "fragile-carry"
    config: FragileCarryConfig
    default_config = FragileCarryConfig()
    # The hand closes over the first five frames, which show the fingertips untouched, as their
    # background.
    start_width = 2 * (RADIUS + 0.016)
    settle_seconds = 0.1

    def instruction(self) -> str:
        """Return the episode's task in words."""
        return "carry the rod to the green rests; do not drop, tilt or crush it"

    def failures(self) -> list[str]:
        """Return which of dropped, tilted, crushed and over_force have happened."""
        return [*self._failed, *super().failures()]

    def episode_info(self) -> dict[str, Any]:
        """Return what distinguishes the episode: forces that hold and crush (N), friction."""
        return super().episode_info() | {
            "hold_force": self.hold_force,
            "crush_force": self.crush_force,
            "friction": self._friction,
        }

    def sample_episode(self, rng: np.random.Generator, options: dict[str, Any]) -> None:
        """Draw the force that holds, the mass, and the tug; the friction follows."""
        config, chosen = self.config, with_options(FragileCarryReset(), options)
        hold, mass = np.exp(rng.uniform(*np.log(_HOLD_FORCE))), rng.uniform(*config.mass)
        self.hold_force = float(hold) if chosen.hold_force is None else chosen.hold_force
        mass = float(mass) if chosen.mass is None else chosen.mass
        weight = 9.81 * mass
        self.crush_force = _CRUSH_RATIO * self.hold_force
        self._friction = _TURN_FACTOR * weight / (2 * self.hold_force)
        self.grasp_force = GRIPPER_MAX_FORCE / 2  # the width target alone limits the force
        self.bodies = [Body(_ROD, (RADIUS, HALF_LENGTH), mass)]
        pull = _TUG * weight
        self._tug = np.array([0, 0, -pull, 0, pull * rng.uniform(-_TUG_ARM, _TUG_ARM), 0])  # N, Nm
        self._tug_place = rng.uniform(-0.03, 0.01)  # m, y, where the tug begins

    def add_task_objects(self, spec: mujoco.MjSpec) -> None:
        """Give the rod its friction; add the rests at start and goal."""
        friction = self._friction
        spec.geom("object").friction = np.array([friction, _TORSION_RADIUS * friction, 1e-4])
        for place, colour in ((START, [0.5, 0.5, 0.55, 1]), (GOAL, [0.1, 0.55, 0.35, 1])):
            for side in (-1, 1):
                spec.worldbody.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_BOX,
                    size=_REST_SIZE,
                    pos=[place[0] + side * _REST_OFFSET, place[1], REST_HEIGHT / 2],
                    rgba=colour,
                    group=VISUAL_GROUP,
                )

    def place_objects(self, rng: np.random.Generator) -> None:
        """Lay the rod on its rests."""
        self.data.joint("object").qpos[:] = [*START, LEVEL, 1, 0, 0, 0]
        self._failed: list[str] = []
        self._lifted, self._squeeze_error = False, 0.0
        self._crush_ticks, self._still_ticks, self._tug_ticks = 0, 0, 0

    def start_joints(self, rng: np.random.Generator) -> Float[np.ndarray, " n"]:
        """Draw joint positions (rad) with the rod between the fingers, 1 mm off the middle at most."""
        aside = np.append(rng.uniform(-0.001, 0.001, 2), 0.0)
        place = np.array([START[0] + GRIP_OFFSET, START[1], LEVEL + GRIP_HEIGHT])
        return self.kinematics.solve_ik(place + aside, fingers_down(0.0), self.robot.arm.home)

    def begin_tick(self) -> None:
        """Tug at the rod on its way, by half a sine wave."""
        if self._tug_ticks or (self._lifted and self.object_pose()[1] > self._tug_place):
            self._tug_ticks += 1
        share = self._tug_ticks / (_TUG_SECONDS * self.config.control_hz)
        size = np.sin(np.pi * min(share, 1.0))
        self.data.xfrc_applied[self.model.body("object").id] = size * self._tug

    def _width_disturbance(self) -> float:
        """Draw a change of the target width (m): a random walk of the squeeze."""
        keep = np.exp(-1 / (self.config.control_hz * DISTURBANCE_SECONDS))
        noise = np.sqrt(1 - keep**2) * self.np_random.normal()
        self._squeeze_error = keep * self._squeeze_error + noise
        share = _SQUEEZE_DISTURBANCE * self.config.disturbance * self._squeeze_error
        return -WIDTH_PER_FORCE * self.hold_force * share

    def in_hand(self) -> tuple[float, float]:
        """Return how far the rod has slid down the pads (m), and its tilt (rad)."""
        rod = self.data.body("object")
        axis = rod.xmat.reshape(3, 3)[:, 0]
        gripped = rod.xpos + GRIP_OFFSET * axis
        slide = self.data.site("tcp").xpos[2] - gripped[2] - GRIP_HEIGHT
        return float(slide), float(np.arcsin(np.clip(-axis[2], -1, 1)))

    def evaluate(self) -> tuple[float, bool]:
        """Return progress in [0, 1] and success; update what has failed."""
        position, (slide, tilt), pads = self.object_pose()[:3], self.in_hand(), self.pad_contacts()
        held = all(pad.touching for pad in pads)
        high = position[2] - LEVEL
        self._lifted |= bool(held and high > _LIFTED)
        crushing = max(pad.normal_force for pad in pads) > self.crush_force
        self._crush_ticks = self._crush_ticks + 1 if crushing else 0
        lost = abs(slide) > _DROP or (self._lifted and not held and high > _CLEAR)
        failed = {
            "dropped": lost,
            "tilted": abs(tilt) > _MAX_TILT,
            "crushed": self._crush_ticks >= _CRUSH_TICKS,
        }
        self._failed += [name for name, true in failed.items() if true and name not in self._failed]
        away = float(np.linalg.norm(position[:2] - GOAL))
        success = self._is_placed(away, high, tilt)
        travelled = 1 - away / float(np.linalg.norm(GOAL - START))
        progress = 0.9 * float(np.clip(travelled, 0, 1)) * self._lifted
        return (1.0 if success else progress), success

    def _is_placed(self, away: float, high: float, tilt: float) -> bool:
        """Return whether the rod lies on the goal's rests; count the ticks for which it does."""
        level = abs(high) < _LEVEL_HEIGHT and abs(tilt) < _LEVEL_TILT
        still = np.linalg.norm(self.data.joint("object").qvel[:3]) < _STILL_SPEED
        placed = self._lifted and level and still and away < _TOLERANCE
        self._still_ticks = self._still_ticks + 1 if placed else 0
        return self._still_ticks >= self.config.control_hz / 4 and not self._failed
