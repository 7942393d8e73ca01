"""The bead maze: lead a bead along a bent wire by touch."""

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from touchgoal.control import features as ft
from touchgoal.control.deployment.follower import GRASP_SECONDS
from touchgoal.control.motion.rotations import fingers_across, rotation_matrix
from touchgoal.sim_envs.cell.environment import FrankaTactileEnv
from touchgoal.sim_envs.config import BeadMazeConfig, BeadMazeReset, with_options
from touchgoal.sim_envs.scene import wires
from touchgoal.sim_envs.scene.build import VISUAL_GROUP
from touchgoal.sim_envs.scene.objects import HARD, Body, Material, ObjectKind, Texture
from touchgoal.sim_envs.scene.wires import LENGTH, Wire

START, END = 0.03, LENGTH - 0.03  # m of arc: where the bead starts and where it has arrived

BEAD_RADIUS, BEAD_LENGTH, BEAD_MASS = 0.010, 0.016, 0.010  # m, m, kg
HOLE_RADIUS, WIRE_RADIUS = 0.0024, 0.00175  # m
_SAG = 6e-5  # m between the wire and its straight pieces, a tenth of the hole's clearance
_WOOD = Material(Texture.SMOOTH, 0.0, 1e-3, HARD, 0.8, (0.78, 0.16, 0.12, 1.0))
BEADS = {
    shape: ObjectKind(
        f"{shape}_bead",
        shape,
        _WOOD,
        ("a hard smooth wooden bead on a wire", "a small smooth bead that slides on a wire"),
    )
    for shape in ("sphere", "cylinder")
}
_SIZES = {"sphere": (BEAD_RADIUS,), "cylinder": (BEAD_RADIUS, BEAD_LENGTH / 2)}

# Bits of MuJoCo's contact masks: the robot (bit 1) meets the bead's outside and the wire; the wire
# (bit 4) meets the bead's hole, but not its outside.
_ROBOT_BIT, _HOLE_BIT = 1, 4


class BeadMaze(FrankaTactileEnv):
    """Grasp the bead, around which the hand starts open, and lead it to the wire's other end.

    The first frames of the fingertips are untouched, as in every task. A fixture holds the bead
    for `GRASP_SECONDS`: on a slope it would slide off while the fingers close.

    `reset` takes the options of `BeadMazeReset`.

    Progress: the fraction of the wire between start and end, 30 mm from the posts. An episode also
    ends when the bead is dropped, jams, or the hand presses too hard: `truth.failure`.
    """

    task = "bead-maze"
    config: BeadMazeConfig
    default_config = BeadMazeConfig()
    disturbance_rotation = 20.0  # rad per m of disturbance: the hole turns with the hand
    start_width = 2 * (BEAD_RADIUS + 0.004)  # just wide enough to stay off the wire
    settle_seconds = 0.1

    @property
    def grasping(self) -> bool:
        """Whether the fixture still holds the bead."""
        return self._ticks < GRASP_SECONDS * self.config.control_hz

    def begin_tick(self) -> None:
        """Let the fixture hold the bead while the hand closes on it."""
        self.data.eq_active[self.model.equality("fixture").id] = self.grasping

    def failures(self) -> list[str]:
        """Return which of drop, jam and over_force hold after the last tick."""
        names = ft.FEATURES[ft.TRUTH_FAILURE].names
        failed = [name for name, true in zip(names, self.failure, strict=True) if true]
        return failed or super().failures()

    def instruction(self) -> str:
        """Return the episode's task in words."""
        return "lead the bead along the wire to its other end"

    def episode_info(self) -> dict[str, Any]:
        """Return what distinguishes the episode: body, wire and disturbance."""
        return super().episode_info() | {
            "wire": self.wire.name,
            "family": self.wire.family,
            "disturbance": self.config.disturbance,
        }

    def sample_episode(self, rng: np.random.Generator, options: dict[str, Any]) -> None:
        """Draw the wire, where it stands, and the grasp force."""
        config = self.config
        chosen = with_options(BeadMazeReset(), options)
        if chosen.wire is not None:
            wire = wires.find_wire(chosen.wire)
        else:
            drawn = config.chosen_wires()
            wire = drawn[rng.integers(len(drawn))]
        place = np.array([0.5, 0.0, 0.17]) + rng.uniform(-0.02, 0.02, 3)
        self.wire = wire.moved(place, rng.uniform(-0.15, 0.15))
        force = rng.uniform(*config.grasp_force)
        self.grasp_force = force if chosen.grasp_force is None else chosen.grasp_force
        self._friction = rng.uniform(*config.wire_friction)
        self.bodies = [Body(BEADS[config.bead], _SIZES[config.bead], BEAD_MASS)]

    def add_task_objects(self, spec: mujoco.MjSpec) -> None:
        """Add the wire, and thread the bead on it."""
        add_wire(spec, self.wire, self._friction)
        add_bead_on_wire(spec, self.wire, self._friction)

    def place_objects(self, rng: np.random.Generator) -> None:
        """Put the bead at the start of the wire, in its fixture."""
        self.data.eq_active[self.model.equality("fixture").id] = 1
        self.arc_length = START
        self.failure = np.zeros(3, bool)
        self._furthest, self._stalled_ticks = START, 0

    def start_joints(self, rng: np.random.Generator) -> Float[np.ndarray, " n"]:
        """Draw joint positions (rad) with the bead nearly in the middle between the fingers."""
        point, tangent = self.wire.at(START)
        R = fingers_across(tangent)
        if self.config.start_angle > 0:
            turn = rng.normal(size=3)
            turn *= np.radians(rng.uniform(0, self.config.start_angle)) / np.linalg.norm(turn)
            R = R @ rotation_matrix(turn)
        offset = R @ np.array([rng.uniform(-0.001, 0.001), 0.0, rng.uniform(-0.001, 0.001)])
        guess = self.robot.arm.home.copy()
        # the hand's yaw; wires head into the half plane y > 0, or nearly so
        guess[-1] -= (np.arctan2(tangent[1], tangent[0]) + np.pi / 2) % (2 * np.pi) - np.pi / 2
        return self.kinematics.solve_ik(point + offset, R, guess)

    def _disturbance(self) -> Float[np.ndarray, " n"]:
        return np.zeros(self.n_joints) if self.grasping else super()._disturbance()

    def evaluate(self) -> tuple[float, bool]:
        """Return progress along the wire in [0, 1] and success; update `failure`."""
        bead = self.object_pose()[:3]
        self.arc_length = self.wire.project(bead, self.arc_length)
        if self.grasping or self.arc_length > self._furthest + 0.002:
            self._furthest, self._stalled_ticks = self.arc_length, 0
        else:
            self._stalled_ticks += 1
        jammed = self._stalled_ticks > self.config.stall_seconds * self.config.control_hz
        self.failure = np.array([self._dropped(bead), jammed, self._force.exceeded])
        progress = float(np.clip((self.arc_length - START) / (END - START), 0.0, 1.0))
        return progress, progress == 1.0 and not self.failure.any()

    def _dropped(self, bead: np.ndarray) -> bool:
        if self.grasping:
            return False
        geom = self.model.geom("object").id
        held = any(geom in pad.geoms for pad in self.pad_contacts())
        point, _ = self.wire.at(self.arc_length)
        return not held or bool(np.linalg.norm(bead - point) > 0.003)

    def _info(self, progress: float, success: bool) -> dict[str, Any]:
        return super()._info(progress, success) | {ft.TRUTH_FAILURE: self.failure}


def add_wire(spec: mujoco.MjSpec, wire: Wire, friction: float) -> None:
    """Add the wire as a chain of capsules on two posts."""
    steel = {
        "type": mujoco.mjtGeom.mjGEOM_CAPSULE,
        "contype": 0,
        "conaffinity": _ROBOT_BIT | _HOLE_BIT,
        "friction": [friction, 0.0, 0.0],
        "condim": 3,
        "priority": 2,
        "solref": [0.003, 1],
        "solimp": [0.9, 0.99, 0.0005, 0.5, 2],
        "group": VISUAL_GROUP,
        "rgba": [0.75, 0.76, 0.8, 1],
    }
    spec.visual.quality.numstacks = 6  # with 16, drawing the capsules takes most of a render
    maze = spec.worldbody.add_body(name="wire")  # own body: MuJoCo tests its bounding box first
    for start, end in wire.chords(sag=_SAG, longest=0.012):
        maze.add_geom(size=[WIRE_RADIUS, 0, 0], fromto=[*start, *end], **steel)
    for foot in wire.points[[0, -1]]:
        post = [*foot[:2], 0.0, *foot]
        maze.add_geom(size=[1.5 * WIRE_RADIUS, 0, 0], fromto=post, **steel)


def add_bead_on_wire(spec: mujoco.MjSpec, wire: Wire, friction: float) -> None:
    """Give the bead its hole, a ring of capsules along its axis (z), and put it on the wire.

    Eight capsules drag 8 % more than Coulomb's law; twelve drag 5 % more and cost more.
    """
    bead = spec.body("object")
    bead.pos, tangent = wire.at(START)
    mujoco.mju_quatZ2Vec(quat := np.zeros(4), tangent)
    bead.quat = quat
    outside = spec.geom("object")
    outside.contype, outside.conaffinity = 0, _ROBOT_BIT
    capsules, radius = 8, 0.0015
    half = BEAD_LENGTH / 2 - radius
    for angle in np.arange(capsules) * (2 * np.pi / capsules):
        x, y = (HOLE_RADIUS + radius) * np.array([np.cos(angle), np.sin(angle)])
        bead.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[radius, 0, 0],
            fromto=[x, y, -half, x, y, half],
            mass=0.0,
            contype=_HOLE_BIT,
            conaffinity=0,
            friction=[friction, 0.0, 0.0],
            condim=3,
            group=VISUAL_GROUP,
            rgba=[0.3, 0.1, 0.1, 1],
        )
    spec.add_equality(
        name="fixture",
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1="object",
        name2="world",
        active=False,
    )
