"""A hand without an arm that grasps, lifts and shakes objects: grasp attempts for TacBench T4.

After the Feeling of Success (Calandra et al. 2017), whose recordings Sparsh's appendix C.6 uses: fingertips
before the grasp, with the object gripped, and just lifted; and whether the object is still held in the
end. Physics, objects and fingertips are those of the scenes. Grip, mass and place of the
grasp are drawn so widely that about half of the attempts fail.
"""

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float32, UInt8

from touchgoal.control.motion.tool import SENSOR_BELOW_CARRIAGE
from touchgoal.control.tactile.sensor_models import SensorModel, find_sensor
from touchgoal.sim_envs.config import RigConfig, SceneConfig
from touchgoal.sim_envs.scene.build import SIDES, add_body, add_fingertip, set_options
from touchgoal.sim_envs.scene.contacts import ContactReader
from touchgoal.sim_envs.scene.objects import CATALOGUE, Body, sample_body
from touchgoal.sim_envs.tactile.pad import TactilePad
from touchgoal.sim_envs.tactile.sensor_instance import SensorInstance, sample_instance

MOMENTS = ("before", "during", "after")
"""Of an attempt's pictures: untouched, gripped, lifted by a centimetre."""
_MASS, _GRIP = (0.1, 1.0), (0.8, 10.0)  # kg, N of each finger: drawn log-uniformly
_ASIDE, _ABOVE = 8e-3, (-4e-3, 10e-3)  # m from the object's middle, along the pads and upwards
_TURN = math.radians(12)  # of the object from where the pads meet it squarely
_OPEN, _CLOSING, _LIFTING = 0.04, 0.08, 0.1  # m of one finger; m/s of one finger; m/s
_LOOKS = 0.05  # s between two looks at the pads, whose stick and slip have a memory
_SEEN_AT, _TOP = 0.01, 0.06  # m of lift
_SHAKE, _SHAKES, _SHAKING = 0.012, 3.0, 1.0  # m, Hz, s
_LOWEST = 0.018  # m: of the pads' middle, or the cases touch the table
_SERVO, _SERVO_DAMPING = 4e4, 4e2  # N/m and N s/m of what moves the hand


@dataclass(frozen=True, eq=False)
class GraspAttempt:
    """One attempt.

    Attributes:
        left, right: the fingertips' pictures at `MOMENTS`, RGB.
        wrench: force (N) and torque (Nm) of the object on the left pad, then the right one, then.
        held: whether the object is still in the hand after the shake.
        body: what was grasped.
        grip: with which each finger presses, N.
    """

    left: UInt8[np.ndarray, "3 h w 3"]
    right: UInt8[np.ndarray, "3 h w 3"]
    wrench: Float32[np.ndarray, "3 12"]
    held: bool
    body: Body
    grip: float


def attempt_grasp(config: RigConfig, index: int) -> GraspAttempt:
    """One attempt; the same config and index always give the same one."""
    sensor, rng = find_sensor(config.sensor), np.random.default_rng([config.seed, index, 3])
    kinds = list(CATALOGUE.values())
    mass, grip = (float(np.exp(rng.uniform(*np.log(ends)))) for ends in (_MASS, _GRIP))
    body = sample_body(kinds[index % len(kinds)], rng, mass)
    units = [
        sample_instance(sensor, np.random.default_rng([config.seed, side])) for side in range(2)
    ]
    hand = _Hand(body, grip, sensor, units, config.shear_relief, rng)
    hand.place(rng)
    hand.run(0.1)
    hand.look(keep=True)
    hand.close()
    hand.look(keep=True)
    hand.lift(_SEEN_AT)
    hand.look(keep=True)
    hand.lift(_TOP)
    hand.shake()
    left, right = (np.stack([looks[side] for looks in hand.pictures]) for side in range(2))
    wrench = np.array(hand.wrenches, np.float32)
    return GraspAttempt(left, right, wrench, hand.holds(), body, grip)


class _Hand:
    """The scene of one attempt, and what was seen in it."""

    def __init__(
        self,
        body: Body,
        grip: float,
        sensor: SensorModel,
        units: list[SensorInstance],
        relief: bool,
        rng: np.random.Generator,
    ) -> None:
        self._body, self._grip, self._rng = body, grip, rng
        self.model = _scene(body, sensor).compile()
        self.data = mujoco.MjData(self.model)
        self.model.actuator("gripper").forcerange[:] = -2 * grip, 2 * grip
        self._reader = ContactReader(self.model)
        self._pads = [
            TactilePad(self.model, side, sensor, unit, [body], relief)
            for side, unit in zip(SIDES, units, strict=True)
        ]
        self._height, self._fingers = 0.0, _OPEN
        self.pictures: list[list[np.ndarray]] = []
        self.wrenches: list[np.ndarray] = []

    def place(self, rng: np.random.Generator) -> None:
        """The object on the table, the open hand around it, a little off."""
        body, data = self._body, self.data
        aside, above = rng.uniform(-_ASIDE, _ASIDE), rng.uniform(*_ABOVE)
        turn = rng.uniform(-_TURN, _TURN)
        pose = data.joint(body.name).qpos
        pose[:3] = aside, 0.0, body.rest_height + 0.001
        pose[3:] = math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)
        self._height = max(body.rest_height + above, _LOWEST)
        data.joint("lift").qpos = data.actuator("lift").ctrl = self._height
        for joint in ("finger_joint1", "finger_joint2"):
            data.joint(joint).qpos = _OPEN
        data.actuator("gripper").ctrl = _OPEN
        mujoco.mj_forward(self.model, data)

    def run(self, seconds: float) -> None:
        """Physics."""
        mujoco.mj_step(self.model, self.data, nstep=round(seconds / self.model.opt.timestep))

    def look(self, keep: bool = False) -> None:
        """Pictures of both pads; to be taken in order of time, kept or not."""
        mujoco.mj_forward(self.model, self.data)
        pads, _ = self._reader.read(self.data)
        seen = [
            p.sense(self.data, c, self._rng).image for p, c in zip(self._pads, pads, strict=True)
        ]
        if keep:
            self.pictures.append(seen)
            self.wrenches.append(np.concatenate([w for c in pads for w in (c.force, c.torque)]))

    def close(self) -> None:
        """Fingers go together until they press with the grip, and a little longer."""
        deepest = -2 * self._grip / float(self.model.actuator("gripper").gainprm[0])
        while self._fingers > -0.005:
            self._fingers -= _CLOSING * _LOOKS / 5
            self.data.actuator("gripper").ctrl = max(self._fingers, -0.002 + deepest)
            self.run(_LOOKS / 5)
        self.look()
        self.run(0.2)

    def lift(self, height: float) -> None:
        """Go up to so much above the table's grasp."""
        servo = self.data.actuator("lift")
        while servo.ctrl[0] < self._height + height:
            servo.ctrl = servo.ctrl + _LIFTING * _LOOKS / 5
            self.run(_LOOKS / 5)
        self.look()

    def shake(self) -> None:
        """To and fro along the pads, then still."""
        step = 0.01
        for t in np.arange(0.0, _SHAKING, step):
            self.data.actuator("shake").ctrl = _SHAKE * math.sin(2 * math.pi * _SHAKES * t)
            self.run(step)
        self.data.actuator("shake").ctrl = 0.0
        self.run(0.2)

    def holds(self) -> bool:
        """Whether the object is in the air."""
        height = self.data.joint(self._body.name).qpos[2]
        return bool(height > self._body.rest_height + _TOP / 3)


def _scene(body: Body, sensor: SensorModel) -> mujoco.MjSpec:
    """A table, an object and a hand on two servos, up and along the pads."""
    spec = mujoco.MjSpec()
    set_options(spec, SceneConfig())
    slide, box = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtGeom.mjGEOM_BOX
    spec.worldbody.add_geom(name="table", type=box, size=[0.2, 0.2, 0.02], pos=[0, 0, -0.02])
    base = spec.worldbody.add_body(name="base", gravcomp=1)
    hand = base.add_body(name="hand", pos=[0, 0, SENSOR_BELOW_CARRIAGE], quat=[0, 1, 0, 0])
    for part, mass in ((base, 0.1), (hand, 1.0)):
        part.explicitinertial, part.mass, part.inertia = True, mass, np.full(3, 1e-3)
        part.ipos, part.iquat, part.gravcomp = np.zeros(3), np.array([1.0, 0, 0, 0]), 1
    base.add_joint(name="shake", type=slide, axis=[1, 0, 0])
    base.add_joint(name="lift", type=slide, axis=[0, 0, 1])
    hand.add_site(name="tcp", pos=[0, 0, SENSOR_BELOW_CARRIAGE])
    for k, side in enumerate(SIDES):
        finger = hand.add_body(name=f"{side}_finger", quat=[[1, 0, 0, 0], [0, 0, 0, 1]][k])
        finger.explicitinertial, finger.mass, finger.inertia = True, 0.1, np.full(3, 1e-4)
        finger.ipos, finger.iquat = np.zeros(3), np.array([1.0, 0, 0, 0])
        finger.gravcomp = 1
        finger.add_joint(
            name=f"finger_joint{k + 1}", type=slide, axis=[0, 1, 0], damping=[20, 0, 0]
        )
    for side in SIDES:
        add_fingertip(spec, side, sensor)
    _add_servos(spec)
    add_body(spec, body)
    return spec


def _add_servos(spec: mujoco.MjSpec) -> None:
    """Of the hand's two slides, and of the mean opening; both fingers go the same way, as a Franka Hand's."""
    affine = {
        "gaintype": mujoco.mjtGain.mjGAIN_FIXED,
        "biastype": mujoco.mjtBias.mjBIAS_AFFINE,
    }
    together = spec.add_tendon(name="split")
    for k in (1, 2):
        together.wrap_joint(f"finger_joint{k}", 0.5)
    equal = spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT, name1="finger_joint1", name2="finger_joint2"
    )
    equal.objtype = mujoco.mjtObj.mjOBJ_JOINT
    equal.data[:2] = 0.0, 1.0
    equal.solref = np.array([0.004, 1])
    servos = (
        ("shake", "shake", mujoco.mjtTrn.mjTRN_JOINT, _SERVO, _SERVO_DAMPING),
        ("lift", "lift", mujoco.mjtTrn.mjTRN_JOINT, _SERVO, _SERVO_DAMPING),
        ("gripper", "split", mujoco.mjtTrn.mjTRN_TENDON, 2e4, 2e2),
    )
    for name, target, kind, stiffness, damping in servos:
        spec.add_actuator(
            name=name,
            target=target,
            trntype=kind,
            gainprm=[stiffness] + [0] * 9,
            biasprm=[0, -stiffness, -damping] + [0] * 7,
            forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
            forcerange=[-2e3, 2e3],
            **affine,
        )
