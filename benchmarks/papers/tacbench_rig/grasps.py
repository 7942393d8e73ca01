"""Grasp attempts for TacBench T4: a hand without an arm that grasps, lifts and shakes objects.

After the Feeling of Success (Calandra et al. 2017), which Sparsh's appendix C.6 uses. Grip, mass
and place are drawn so widely that about half of the attempts fail.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float32, UInt8

from benchmarks.papers.tacbench_rig.config import RigConfig
from touchgoal.control.tactile.sensor_models import SensorModel, find_sensor
from touchgoal.sim_envs.config import SceneConfig
from touchgoal.sim_envs.scene.build import SIDES, add_body, add_fingertip, set_options
from touchgoal.sim_envs.scene.contacts import ContactReader
from touchgoal.sim_envs.scene.objects import CATALOGUE, Body, sample_body
from touchgoal.sim_envs.tactile.pad import TactilePad
from touchgoal.sim_envs.tactile.sensor_instance import SensorInstance, sample_instance

MOMENTS = ("before", "during", "after")
"""Moments of an attempt's images: untouched, gripped, lifted by a centimetre."""
_MASS, _GRIP = (0.1, 1.0), (0.8, 10.0)  # kg, N of each finger: drawn log-uniformly
_ASIDE, _ABOVE = 8e-3, (-4e-3, 10e-3)  # m from the object's middle, along the pads and upwards
_TURN = math.radians(12)  # largest turn of the object against the pads
_OPEN, _CLOSING, _LIFTING = 0.04, 0.08, 0.1  # m of one finger; m/s of one finger; m/s
_STEP = 0.01  # s between set-points
_SHOWN_AT, _TOP = 0.01, 0.06  # m of lift: at the third image, before the shake
_SHAKE, _SHAKES, _SHAKING = 0.012, 3.0, 1.0  # m, Hz, s
_LOWEST = 0.018  # m: lowest height of the pads' middle above the table


@dataclass(frozen=True, eq=False)
class GraspAttempt:
    """One attempt to grip and lift an object."""

    # left, right: the fingertips' images at `MOMENTS`, RGB
    left: UInt8[np.ndarray, "3 h w 3"]
    right: UInt8[np.ndarray, "3 h w 3"]
    # force (N) and torque (Nm) of the object on the left, then the right pad, at `MOMENTS`
    wrench: Float32[np.ndarray, "3 12"]
    held: bool  # whether the object is still in the hand after the shake
    body: Body  # the object
    grip: float  # force of each finger, N


def attempt_grasp(config: RigConfig, index: int) -> GraspAttempt:
    """Simulate one attempt; the same config and index always give the same one."""
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
    hand.read_pads(keep=True)
    hand.close()
    hand.read_pads(keep=True)
    hand.lift(_SHOWN_AT)
    hand.read_pads(keep=True)
    hand.lift(_TOP)
    hand.shake()
    left, right = (np.stack([images[side] for images in hand.images]) for side in range(2))
    wrench = np.array(hand.wrenches, np.float32)
    return GraspAttempt(left, right, wrench, hand.holds(), body, grip)


class _Hand:
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
        self.images: list[list[np.ndarray]] = []
        self.wrenches: list[np.ndarray] = []

    def place(self, rng: np.random.Generator) -> None:
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
        mujoco.mj_step(self.model, self.data, nstep=round(seconds / self.model.opt.timestep))

    def read_pads(self, keep: bool = False) -> None:
        """Read both pads, whose stick and slip depend on earlier readings; `keep` stores them."""
        mujoco.mj_forward(self.model, self.data)
        pads, _ = self._reader.read(self.data)
        images = [
            p.sense(self.data, c, self._rng).image for p, c in zip(self._pads, pads, strict=True)
        ]
        if keep:
            self.images.append(images)
            self.wrenches.append(np.concatenate([w for c in pads for w in (c.force, c.torque)]))

    def close(self) -> None:
        """Close the fingers until they press with the grip, and a little longer."""
        deepest = -2 * self._grip / float(self.model.actuator("gripper").gainprm[0])
        while self._fingers > -0.005:
            self._fingers -= _CLOSING * _STEP
            self.data.actuator("gripper").ctrl = max(self._fingers, -0.002 + deepest)
            self.run(_STEP)
        self.read_pads()
        self.run(0.2)

    def lift(self, height: float) -> None:
        servo = self.data.actuator("lift")
        while servo.ctrl[0] < self._height + height:
            servo.ctrl = servo.ctrl + _LIFTING * _STEP
            self.run(_STEP)
        self.read_pads()

    def shake(self) -> None:
        for t in np.arange(0.0, _SHAKING, _STEP):
            self.data.actuator("shake").ctrl = _SHAKE * math.sin(2 * math.pi * _SHAKES * t)
            self.run(_STEP)
        self.data.actuator("shake").ctrl = 0.0
        self.run(0.2)

    def holds(self) -> bool:
        height = self.data.joint(self._body.name).qpos[2]
        return bool(height > self._body.rest_height + _TOP / 3)


def _scene(body: Body, sensor: SensorModel) -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_file(str(Path(__file__).with_name("grasp_rig.xml")))
    set_options(spec, SceneConfig())
    for side in SIDES:
        add_fingertip(spec, side, sensor)
    add_body(spec, body)
    return spec
