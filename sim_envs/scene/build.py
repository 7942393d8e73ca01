"""The MuJoCo scene: an arm with two fingertip sensors, a table, cameras, objects.

World frame = the robot's base frame, table top at z = 0.
"""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from touchgoal.control.motion.tool import FRANKA_HAND, SENSOR_BELOW_CARRIAGE, Tool
from touchgoal.control.motion.tracker import SERVO_DAMPING
from touchgoal.control.safety import limits
from touchgoal.control.tactile.sensor_models import SensorModel, find_sensor
from touchgoal.sim_envs.config import MAX_CAMERA_SIDE, SceneConfig
from touchgoal.sim_envs.scene.objects import FIRM, Body
from touchgoal.sim_envs.scene.variety import place_camera

SIDES = ("left", "right")
OBJECT_GROUP, VISUAL_GROUP, HIDDEN_GROUP = 1, 2, 3
NO_CONTACT: dict[str, Any] = {"contype": 0, "conaffinity": 0}
"""Options of a geom that meets nothing."""
GRIPPER_MAX_FORCE = 80.0  # N, both fingers; opening never needs a limit below it

# MJCF of each arm; `docs/fr3_model.py` made the FR3's and its meshes.
MODELS = {
    "fr3": Path(__file__).parent / "fr3/fr3.xml",
    "ur5e": Path(__file__).with_name("ur5e.xml"),
}
ROBOTS = {"fr3": limits.FR3, "ur5e": limits.UR5E}
_STIFFNESS = {  # N m/rad: Franka's default (fr3.xml), stiff enough for the UR5e (our choice)
    "fr3": (4500.0, 4500.0, 3500.0, 3500.0, 2000.0, 2000.0, 2000.0),
    "ur5e": (4500.0, 4500.0, 4500.0, 2000.0, 2000.0, 2000.0),
}


def build(bodies: list[Body], config: SceneConfig | None = None) -> mujoco.MjSpec:
    """Build the scene's spec; tasks add to it before they compile it."""
    config = config or SceneConfig()
    spec = _robot(config.arm, config.meshes).copy()
    set_options(spec, config)
    base = spec.body("base")
    for body in (base, *base.find_all("body")):
        body.gravcomp = 1
    for side in SIDES:
        add_fingertip(spec, side, find_sensor(config.sensor))
    _add_actuators(spec, config.arm)
    _add_cameras_and_table(spec, ROBOTS[config.arm].tool)
    for name, placement in (("front", config.front_camera), ("wrist", config.wrist_camera)):
        if placement is not None:
            place_camera(spec.camera(name), placement)
    for body in bodies:
        add_body(spec, body)
    return spec


@lru_cache(maxsize=4)  # reading and stripping it takes longer than compiling a scene
def _robot(arm: str, meshes: str) -> mujoco.MjSpec:
    """Return the spec of an arm alone, to be copied."""
    spec = mujoco.MjSpec.from_file(str(MODELS[arm]))
    if arm == "fr3":
        # No posture brings these together (none of 20,000 random ones did), but they lie so near
        # that the solver would examine each pair in every step.
        for i, k in ((0, 2), (2, 4), (3, 5)):
            spec.add_exclude(bodyname1=f"fr3_link{i}", bodyname2=f"fr3_link{k}")
    _strip(spec, fast=meshes == "fast")
    return spec


def set_options(spec: mujoco.MjSpec, config: SceneConfig) -> None:
    """Set solver and drawing options of any scene with a fingertip."""
    option = spec.option
    option.timestep = 1e-3  # s
    # `discrete` keeps implicit damping when an actuator saturates; with `implicitfast` MuJoCo
    # 4.0.0 shakes a grasped object several mm out of the hand at each set-point step.
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    # Elliptic cones at impratio 1000: a held object creeps 0.001 mm/s instead of 1.
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 1000
    # 4.0.0's sparse Newton factorisation is wrong (fixed in 4.0.1); at our size dense is as fast.
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    # One small island: looking for more costs 10 % of a step. Creep is the same at both tolerances.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    option.tolerance = 1e-6
    spec.stat.extent = 1.0
    spec.stat.center = np.array([0.5, 0.0, 0.2])
    visual = spec.visual
    visual.map.znear, visual.map.zfar = 0.01, 10.0  # m: the wrist camera is near the fingers
    visual.global_.offheight = visual.global_.offwidth = MAX_CAMERA_SIDE
    visual.headlight.active = 1
    visual.headlight.ambient = np.full(3, 0.3, np.float32)
    visual.headlight.diffuse = np.full(3, 0.3, np.float32)
    visual.headlight.specular = np.zeros(3, np.float32)
    visual.quality.shadowsize = 0 if config.meshes == "fast" else 1024
    visual.quality.offsamples = 0 if config.meshes == "fast" else 4
    visual.quality.numslices = 24


def _strip(spec: mujoco.MjSpec, fast: bool) -> None:
    """Remove keyframes, servos and finger shapes of the maker's model."""
    for item in [*spec.keys, *spec.actuators]:
        spec.delete(item)
    for side in SIDES:
        for geom in list(spec.body(f"{side}_finger").geoms):
            spec.delete(geom)
    # Finger joints at their stops would otherwise be as soft as a contact.
    for joint in ("finger_joint1", "finger_joint2"):
        spec.joint(joint).solref_limit = np.array([0.004, 1])
    for body in spec.bodies:
        for geom in list(body.geoms):
            is_visual = geom.meshname != "" and not geom.meshname.endswith("_coll")
            if is_visual and fast:
                spec.delete(geom)
            elif not is_visual and fast:
                geom.group = VISUAL_GROUP
                geom.rgba = [0.92, 0.92, 0.94, 1]
    used = {geom.meshname for body in spec.bodies for geom in body.geoms}
    for mesh in [m for m in spec.meshes if m.name not in used]:
        spec.delete(mesh)


def add_fingertip(spec: mujoco.MjSpec, side: str, sensor: SensorModel) -> None:
    """Add carriage, adapter, sensor case and gel of one finger.

    The gel is a rigid plate on three springs (normal, two shear). Its collision box reaches 12 mm
    into the case, because a thin box flips its contact normals when squeezed.
    """
    finger = spec.body(f"{side}_finger")
    box = mujoco.mjtGeom.mjGEOM_BOX
    z = SENSOR_BELOW_CARRIAGE
    length, width, depth = sensor.case_size
    protrusion = sensor.gel_thickness + 0.0005  # the case must never take the load
    grey, black = [0.3, 0.3, 0.32, 1], [0.12, 0.12, 0.13, 1]
    visual = {"mass": 0.0, "group": VISUAL_GROUP, "rgba": grey, **NO_CONTACT}
    # Adapter (GelSight's STEP file): mount block 21 x 25 mm on the carriage, arm 30 x 12 mm.
    finger.add_geom(type=box, size=[0.0105, 0.0125, 0.010], pos=[0, 0.014, 0.010], **visual)
    arm = (z - length / 2 - 0.018) / 2
    finger.add_geom(type=box, size=[0.015, 0.006, arm], pos=[0, 0.024, 0.018 + arm], **visual)
    finger.add_geom(
        name=f"{side}_case",
        type=box,
        size=[width / 2, (depth - protrusion) / 2, length / 2],
        pos=[0, (depth + protrusion) / 2, z],
        mass=0.0,
        friction=[0.5, 0.005, 0.0001],
        group=VISUAL_GROUP,
        rgba=black,
    )
    # Sensor frame: x down the finger, z out of the gel (towards the other finger), y = z x x.
    axes = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    finger.add_site(name=f"{side}_sensor", pos=[0, 0, z], quat=quaternion(axes), group=HIDDEN_GROUP)
    _add_gel(spec, finger, side, sensor, z)


def _add_gel(
    spec: mujoco.MjSpec, finger: mujoco.MjsBody, side: str, sensor: SensorModel, z: float
) -> None:
    mass, damping_ratio = 0.005, 0.7  # kg of gel; damped enough not to ring
    gel = finger.add_body(name=f"{side}_gel", pos=[0, 0, z], gravcomp=1)
    gel.explicitinertial = True
    gel.mass, gel.inertia = mass, np.full(3, 1e-6)
    gel.ipos, gel.iquat = np.zeros(3), np.array([1.0, 0, 0, 0])
    springs = (
        ("normal", [0, 1, 0], sensor.normal_stiffness),
        ("shear_x", [0, 0, 1], sensor.shear_stiffness),
        ("shear_y", [-1, 0, 0], sensor.shear_stiffness),
    )
    for name, axis, stiffness in springs:
        gel.add_joint(
            name=f"{side}_gel_{name}",
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=axis,
            stiffness=[stiffness, 0, 0],
            damping=[2 * damping_ratio * np.sqrt(stiffness * mass), 0, 0],
            armature=0.0,
            frictionloss=0.0,
        )
    gel.add_geom(
        name=f"{side}_pad",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[sensor.gel_size[1] / 2, 0.006, sensor.gel_size[0] / 2],
        pos=[0, 0.006, 0],
        mass=0.0,
        group=VISUAL_GROUP,
        rgba=[0.75, 0.75, 0.78, 1],
    )
    other = "right" if side == "left" else "left"
    for body in (f"{side}_finger", f"{other}_finger", "hand"):
        spec.add_exclude(bodyname1=f"{side}_gel", bodyname2=body)
    if side == "left":
        spec.add_exclude(bodyname1="left_finger", bodyname2="right_finger")
    spec.add_exclude(bodyname1="hand", bodyname2=f"{side}_finger")


def arm_joints(arm: str) -> list[str]:
    """Return the names of an arm's joints, from the base outwards."""
    return [f"{arm}_joint{i}" for i in range(1, ROBOTS[arm].arm.home.size + 1)]


def _add_actuators(spec: mujoco.MjSpec, arm: str) -> None:
    for i, (name, stiffness) in enumerate(zip(arm_joints(arm), _STIFFNESS[arm], strict=True), 1):
        joint = spec.joint(name)
        servo = spec.add_actuator(
            name=f"joint_{i}",
            target=joint.name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            ctrlrange=joint.range.tolist(),
        )
        servo.set_to_position(stiffness, kv=SERVO_DAMPING * stiffness)
    # One servo on the mean finger opening, stiff enough that the force clamp, set at run time to
    # the grasp force, is what it delivers; the model's own hand is a 100 N/m spring.
    servo = spec.add_actuator(
        name="gripper",
        target="split",
        trntype=mujoco.mjtTrn.mjTRN_TENDON,
        forcerange=[-GRIPPER_MAX_FORCE, GRIPPER_MAX_FORCE],
    )
    servo.set_to_position(2.0e4, kv=200.0)


def _add_cameras_and_table(spec: mujoco.MjSpec, tool: Tool) -> None:
    world = spec.worldbody
    hand = spec.body("hand")
    hand.add_site(name="tcp", pos=[0, 0, tool.tcp_offset], group=HIDDEN_GROUP)
    longer = tool.tcp_offset - FRANKA_HAND.tcp_offset  # keeps the view of the fingers
    eye = [0.075, 0.0, 0.02 + longer]
    hand.add_camera(
        name="wrist", pos=eye, quat=look_at(eye, [0.012, 0, 0.17 + longer], [1, 0, 0]), fovy=62
    )
    for name, eye, target, fovy in (
        ("front", [1.15, 0.0, 0.55], [0.46, 0.0, 0.10], 40),
        ("side", [0.62, -0.95, 0.42], [0.45, 0.0, 0.17], 40),
    ):
        world.add_camera(name=name, pos=eye, quat=look_at(eye, target, [0, 0, 1]), fovy=fovy)
    world.add_light(pos=[0.6, -0.6, 1.6], dir=[-0.1, 0.4, -1], castshadow=True, diffuse=[0.5] * 3)
    world.add_light(pos=[0.9, 0.8, 1.5], dir=[-0.3, -0.5, -1], castshadow=False, diffuse=[0.3] * 3)
    world.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.4, 0.5, 0.02],
        pos=[0.55, 0, -0.02],
        rgba=[0.62, 0.6, 0.57, 1],
        group=VISUAL_GROUP,
    )
    world.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[3, 3, 0.1],
        pos=[0, 0, -0.4],
        rgba=[0.35, 0.38, 0.42, 1],
        group=VISUAL_GROUP,
        **NO_CONTACT,
    )


def geom_type(shape: str) -> mujoco.mjtGeom:
    """Return MuJoCo's number of a shape of `objects.SHAPES`."""
    return getattr(mujoco.mjtGeom, f"mjGEOM_{shape.upper()}")


def add_body(spec: mujoco.MjSpec, body: Body) -> None:
    """Put an object, free to move, into a scene."""
    kind = body.kind
    item = spec.worldbody.add_body(name=body.name)
    item.add_freejoint(name=body.name)
    shape: dict = {"size": [*body.size, 0, 0][:3]}
    if kind.shape == "capsule":
        shape["quat"] = [np.sqrt(0.5), 0, np.sqrt(0.5), 0]  # lies along the body's x axis
    if kind.shape == "mesh":
        assert body.hull is not None
        spec.add_mesh(name=body.name, uservert=body.hull.ravel().tolist())
        shape = {"meshname": body.name}
    # Round objects get rolling friction (condim 6), or they never come to rest on the table.
    rolls = kind.shape in ("sphere", "capsule")
    soft = kind.material.foundation_modulus < FIRM
    item.add_geom(
        name=body.name,
        type=geom_type(kind.shape),
        mass=body.mass,
        rgba=kind.material.rgba,
        group=OBJECT_GROUP,
        priority=1,  # The object's contact parameters hold against gel and table alike.
        condim=6 if rolls else 4,
        # Torsion of a patch of 5 mm radius, as of a 10 N grasp (8/15 of it: Hertz' pressure).
        friction=[kind.material.friction, 0.0025, 0.0005 if rolls else 0.0001],
        solref=[0.008 if soft else 0.004, 1],
        solimp=[0.95, 0.99, 0.001, 0.5, 2],
        **shape,
    )


def quaternion(R: np.ndarray) -> list[float]:
    """Return the quaternion (wxyz) of a rotation, (3, 3) or its 9 numbers by rows."""
    mujoco.mju_mat2Quat(quat := np.empty(4), np.ravel(R))
    return quat.tolist()


def look_at(eye: Sequence[float], target: Sequence[float], up: Sequence[float]) -> list[float]:
    """Return the orientation (wxyz) of a camera at `eye` that looks at `target`, `up` upwards."""
    z = np.subtract(eye, target)
    z = z / np.linalg.norm(z)
    x = np.cross(up, z)
    x = x / np.linalg.norm(x)
    return quaternion(np.stack([x, np.cross(z, x), z], axis=1))
