"""The task of the paper's robot experiment: pick an object up and place it at a goal."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, Float32

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.sim_envs.cell.environment import FrankaTactileEnv
from touchgoal.sim_envs.config import PickPlaceConfig, PickPlaceReset, with_options
from touchgoal.sim_envs.scene.build import NO_CONTACT, VISUAL_GROUP
from touchgoal.sim_envs.scene.objects import CATALOGUE, find_object, sample_body

Hand = Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, " j"]]
"""Joints (rad) of an arm for objects at these positions on the table (m, base frame)."""
WORKSPACE = ((0.40, 0.60), (-0.20, 0.20))  # m, where objects start and goals lie, base frame
_GONE, _ABOVE = (0.5, 0.9), 2e-3  # m: a place beside the table; over the table, to fall from
_LIFTED = 0.03  # m above rest that counts as picked up
_MOST_MISSES = 200  # draws too near to another place, after which all places are drawn again
_SIDES = 8  # to which an object is moved, at most, until it is not in the hand
_APART = 0.12  # m at least between objects, and between start and goal


class PickPlace(FrankaTactileEnv):
    """Pick the object up and place it on the disc.

    `reset` takes the options of `PickPlaceReset`.

    Success: the object, once lifted by 3 cm, lies at rest on the table within `tolerance` of the
    goal for half a second, and is let go if `release` asks for it; it must be the object that the
    instruction asks for. Progress: reaching (to 0.25),
    grasped (0.35), carrying (to 0.85), lowering (to 0.95), success (1).
    """

    task = "pick-place"
    config: PickPlaceConfig
    default_config = PickPlaceConfig()

    def instruction(self) -> str:
        """Return the episode's task in words."""
        return f"pick up the {self.asked_name} and place it on the disc"

    @property
    def asked_name(self) -> str:
        """The object to place, in words; one's own is named after its mesh file."""
        return Path(self.asked).stem.replace("_", " ")

    def episode_info(self) -> dict[str, Any]:
        """Return what distinguishes this episode: the object, how it is gripped, what was asked."""
        return super().episode_info() | {"asked": self.asked}

    def scene_layout(self) -> dict[str, list[float]]:
        """Return object pose, grasp (m, yaw in rad) and goal (m), base frame."""
        grasp = [*self.object_pose()[:3].tolist(), self.grasp_yaw()]
        return super().scene_layout() | {"grasp": grasp, "goal": self.goal.tolist()}

    def grasp_yaw(self, name: str = "object") -> float:
        """Return the hand yaw that closes across an object, in [-pi/2, pi/2]."""
        body = next(b for b in self.bodies if b.name == name)
        if body.kind.shape in ("sphere", "cylinder", "mesh") and body.kind.hull is None:
            return 0.0
        w, x, y, z = self.object_pose(name)[3:]
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        if body.kind.shape == "box" and body.size[0] < body.size[1]:
            yaw += np.pi / 2  # close along the narrower side
        return float((yaw + np.pi / 2) % np.pi - np.pi / 2)

    def rearrange(self, hand: Hand | None = None) -> tuple[Observation, dict[str, Any]]:
        """Start a new episode with the same objects, without the cost of a reset.

        Objects, goal and hand are moved to places that a reset could draw; objects keep the side
        they lie on. `hand` (objects' positions on the table, m, base frame -> joints, rad) says
        where the hand is instead.
        """
        rng, data = self.np_random, self.data
        *positions, self.goal = _random_positions(rng, len(self.bodies) + 1)
        self.model.geom("goal").pos[:2] = self.goal
        for body, position in zip(self.bodies, positions, strict=True):
            pose, turn = data.joint(body.name).qpos, rng.uniform(-np.pi, np.pi)
            pose[:2] = position
            mujoco.mju_mulQuat(
                pose[3:], np.array([np.cos(turn / 2), 0, 0, np.sin(turn / 2)]), pose[3:].copy()
            )
        at = np.array(positions)
        self.command = self._command_before = hand(at) if hand else self.start_joints(rng)
        data.qpos[self.arm_positions] = self.command
        data.qvel[:] = 0
        self.update_contacts()
        self._note_start()
        self._begin_episode()
        return self._observe(), self._info(0.0, False)

    def sample_episode(self, rng: np.random.Generator, options: dict[str, Any]) -> None:
        """Draw the object, its mass, the grasp force, the distractors, and where all of them go."""
        config = self.config
        chosen = with_options(PickPlaceReset(), options)
        kinds = [find_object(name) for name in config.objects] or list(CATALOGUE.values())
        kind = kinds[rng.integers(len(kinds))]
        if chosen.object is not None:
            kind = find_object(chosen.object)
        mass, force = rng.uniform(*config.mass), rng.uniform(*config.grasp_force)
        self.grasp_force = force if chosen.grasp_force is None else chosen.grasp_force
        self.asked = chosen.asked or kind.name
        self.bodies = [sample_body(kind, rng, mass if chosen.mass is None else chosen.mass)]
        others = [k for k in CATALOGUE.values() if k.name != kind.name]
        for i in range(config.distractors):
            other = others[rng.integers(len(others))]
            self.bodies.append(
                sample_body(other, rng, rng.uniform(*config.mass), f"distractor_{i + 1}")
            )
        factors = config.size_factor, config.friction_factor
        if factors != (1.0, 1.0):
            self.bodies = [body.scaled(*factors) for body in self.bodies]
        taken = [np.array(p) for p in (chosen.start, chosen.goal) if p is not None]
        drawn = iter(_random_positions(rng, len(self.bodies) + 1 - len(taken), taken))
        start = next(drawn) if chosen.start is None else np.array(chosen.start)
        self._positions = [start, *(next(drawn) for _ in self.bodies[1:])]
        self.goal = next(drawn) if chosen.goal is None else np.array(chosen.goal)

    def add_task_objects(self, spec: mujoco.MjSpec) -> None:
        """Add the disc that marks the goal."""
        spec.worldbody.add_geom(
            name="goal",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[0.03, 0.0005, 0],
            pos=[*self.goal, 0.0005],
            rgba=[0.1, 0.55, 0.35, 1],
            group=VISUAL_GROUP,
            **NO_CONTACT,
        )

    def place_objects(self, rng: np.random.Generator) -> None:
        """Put the objects on the table, turned at random."""
        for body, position in zip(self.bodies, self._positions, strict=True):
            yaw = rng.uniform(-np.pi, np.pi)
            joint = self.data.joint(body.name)
            joint.qpos[:3] = *position, body.rest_height + 0.001
            joint.qpos[3:] = np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)

    def begin_tick(self) -> None:
        """Move the object a second after the start, if `nudge` asks for it."""
        if self.config.nudge and self._ticks == self.config.control_hz:
            self._nudge()
        if self.config.interference and not self._interfered:
            self._interfere(self.config.interference == "taken")

    def _nudge(self) -> None:
        """Move the object to any side, but not into the hand; it stays if the hand is all around."""
        pose = self.data.joint("object").qpos
        before = pose[:2].copy()
        for _ in range(_SIDES):
            angle = self.np_random.uniform(-np.pi, np.pi)
            pose[:2] = before + self.config.nudge * np.array([np.cos(angle), np.sin(angle)])
            self.update_contacts()
            if not self.external_wrench().any():
                return
        pose[:2] = before

    def _interfere(self, taken: bool) -> None:
        """Take the object away, or knock it out of the hand onto the table, once the time has come."""
        joint, (hand, _) = self.data.joint("object"), self.kinematics.forward(self.command)
        over = np.linalg.norm(hand[:2] - joint.qpos[:2]) < 0.02 and hand[2] < 0.07
        lifted = joint.qpos[2] > self.start[2] + 0.05
        if not (over if taken else lifted):
            return
        angle, self._interfered = self.np_random.uniform(-np.pi, np.pi), True
        aside = joint.qpos[:2] + 0.07 * np.array([np.cos(angle), np.sin(angle)])
        joint.qpos[:2] = _GONE if taken else np.clip(aside, *np.array(WORKSPACE).T)
        joint.qpos[2] = (
            self.bodies[0].rest_height + _ABOVE
        )  # at the hand's height it may be in a finger
        joint.qvel[:] = 0

    def _let_settle(self) -> None:
        super()._let_settle()
        self._note_start()

    def start_of(self, name: str) -> Float32[np.ndarray, "7"]:
        """Return `features.TRUTH_START` as if this object were the one to place."""
        position, twice = self.object_pose(name)[:3], 2 * self.grasp_yaw(name)
        return np.array([*position, np.cos(twice), np.sin(twice), *self.goal], np.float32)

    def _note_start(self) -> None:
        self.start = self.start_of("object")
        self._initial_distance = max(self._tcp_distance(self.start[:3]), 1e-3)
        self._still_ticks, self._lifted, self._put_down = 0, False, False
        self._interfered = False

    def _info(self, progress: float, success: bool) -> dict[str, Any]:
        return super()._info(progress, success) | {ft.TRUTH_START: self.start.copy()}

    def _disturbance(self) -> Float[np.ndarray, " n"]:
        return np.zeros(self.n_joints) if self._put_down else super()._disturbance()

    def evaluate(self) -> tuple[float, bool]:
        """Return progress in [0, 1] and success; record what was lifted and put down."""
        position = self.object_pose()[:3]
        height = float(position[2] - self.start[2])
        self._lifted |= height > _LIFTED
        away = float(np.linalg.norm(position[:2] - self.goal))
        held = all(pad.touching for pad in self.pad_contacts())
        let_go = not any(pad.touching for pad in self.pad_contacts())
        speed = float(np.abs(self.data.joint("object").qvel).max())
        # A held object that grazes the table loses contact at times: below 1 mm it is down, too.
        down = self.object_on_table() or height < 1e-3
        self._put_down = self._lifted and down
        near = away < self.config.tolerance and self.asked == self.bodies[0].kind.name
        there = self._put_down and near and speed < 0.05
        placed = there and (let_go or not self.config.release)
        self._still_ticks = self._still_ticks + 1 if placed else 0
        success = self._still_ticks >= self.config.control_hz // 2
        if there:
            return 1.0 if success else 0.95, success
        if not held:
            nearer = 1 - self._tcp_distance(position) / self._initial_distance
            return 0.25 * float(np.clip(nearer, 0, 1)), False
        travelled = 1 - away / float(np.linalg.norm(self.start[:2] - self.goal))
        carried = 0.35 + 0.5 * float(np.clip(travelled, 0, 1))
        if away < self.config.tolerance:
            carried += 0.1 * float(np.clip(1 - height / 0.1, 0, 1))
        return carried, False

    def _tcp_distance(self, position: np.ndarray) -> float:
        return float(np.linalg.norm(self.data.site("tcp").xpos - position))

    def object_on_table(self, name: str = "object") -> bool:
        """Return whether the table carries the object."""
        return self._reader.touches(
            self.data, self.model.geom(name).id, self.model.geom("table").id
        )


def _random_positions(
    rng: np.random.Generator, n: int, taken: Sequence[np.ndarray] = ()
) -> list[np.ndarray]:
    """Draw positions in the workspace (m), `_APART` from each other and from those taken."""
    low, high = np.array(WORKSPACE).T
    points: list[np.ndarray] = []
    misses = 0
    while len(points) < n:
        point = rng.uniform(low, high)
        if all(np.linalg.norm(point - other) > _APART for other in (*taken, *points)):
            points.append(point)
        else:
            misses += 1
        if misses == _MOST_MISSES:  # the first points leave no room for the others
            points, misses = [], 0
    return points
