"""A UR5e with a Robotiq 2F-85 in place of the FR3 and its hand, with the same fingertip sensors.

No wheel ships either model, so both are built from what their makers publish: kinematics, masses,
centres of mass, inertias and joint torques of the arm; length, stroke, mass and its centre of the
gripper. Their shapes are capsules and boxes. The gripper's fingers slide straight, where a real one's
go round on links and rise by 13 mm as they open.
"""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from touchgoal.control.motion.arm_models import UR5E_ARM
from touchgoal.control.motion.rotations import rotation_matrix
from touchgoal.control.motion.tool import ROBOTIQ_2F85, SENSOR_BELOW_CARRIAGE

Point = tuple[float, float, float]


@dataclass(frozen=True)
class _Link:
    """A link as Universal Robots describes it (article 45257), in its Denavit-Hartenberg frame.

    Attributes:
        mass: kg.
        centre: of mass, m.
        inertia: about that: xx, yy, zz, xy, xz, yz, kg m^2.
        torque: N m, the joint's most (Universal_Robots_ROS2_Description ur5e/joint_limits.yaml).
        capsules: (start, end, radius) in m, in the frame of the link's joint. The upper arm runs 138 mm
            beside the shoulder's axis, the forearm 7 mm (UR5e drawing); radii are ours, within 6 mm of
            those of MuJoCo Menagerie, which were fitted to the maker's meshes.
    """

    mass: float
    centre: Point
    inertia: tuple[float, float, float, float, float, float]
    torque: float
    capsules: tuple[tuple[Point, Point, float], ...]


# Inertias: Universal_Robots_ROS2_Description ur5e/physical_parameters.yaml, after the same article.
_LINKS = (
    _Link(
        3.761,
        (0.0, -0.02561, 0.00193),
        (0.0070021, 0.00648091, 0.00657286, 7.3e-7, -1.053e-5, 0.00049994),
        150.0,
        (((0, 0, 0.04), (0, 0, 0.16), 0.06),),
    ),
    _Link(
        8.058,
        (0.2125, 0.0, 0.11336),
        (0.01505885, 0.33388086, 0.33247207, -5.4e-5, 5.63e-6, -1.81e-6),
        150.0,
        (((0, 0, 0.02), (0, 0, 0.138), 0.06), ((0, 0, 0.138), (-0.425, 0, 0.138), 0.054)),
    ),
    _Link(
        2.846,
        (0.15, 0.0, 0.0265),
        (0.00399632, 0.07879254, 0.0784851, -1.365e-5, 0.00137272, -6.6e-6),
        150.0,
        (((0, 0, 0.12), (0, 0, 0.007), 0.05), ((0, 0, 0.007), (-0.392, 0, 0.007), 0.043)),
    ),
    _Link(
        1.37,
        (0.0, -0.0018, 0.01634),
        (0.00165491, 0.00135962, 0.00126279, -2.82e-6, -4.38e-6, 0.00010157),
        28.0,
        (((0, 0, 0.02), (0, 0, 0.133), 0.042),),
    ),
    _Link(
        1.3,
        (0.0, 0.0018, 0.01634),
        (0.00135617, 0.00127827, 0.00096614, -2.74e-6, 4.44e-6, -5.048e-5),
        28.0,
        (((0, 0, 0.02), (0, 0, 0.0997), 0.042),),
    ),
    _Link(
        0.365,
        (0.0, 0.0, -0.001159),
        (0.00018694, 0.00018908, 0.00025756, 6e-8, -1.7e-7, -9.2e-7),
        28.0,
        (((0, 0, 0.05), (0, 0, 0.06), 0.0375),),
    ),
)
_ARMATURE = (0.2, 0.2, 0.2, 0.1, 0.1, 0.1)  # kg m^2, of rotor and gear: our choice

# The gripper's outline, our reading of the maker's drawing: the coupling on the flange, a body up to
# the knuckles. Moving parts of one side: 61 g (MuJoCo Menagerie's robotiq_2f85).
_COUPLING = 0.0375, 0.0108  # m: radius, height
_BODY = 0.0315, 0.0375, 0.08  # m: half depth, half width, top
_FINGER_MASS = 0.061  # kg

_ARM_RGBA, _GRIPPER_RGBA = "0.72 0.76 0.8 1", "0.2 0.2 0.22 1"


def replace_arm_with_ur5e(franka: Path) -> str:
    """MJCF of the model in `franka`, its arm replaced by a UR5e and its hand by a 2F-85."""
    tree = ET.parse(franka).getroot()
    world, hand = tree.find("worldbody"), tree.find(".//body[@name='hand']")
    assert world is not None and hand is not None
    for named in ("actuator", "contact", "keyframe"):  # of the FR3's own joints and links
        for part in tree.findall(named):
            tree.remove(part)
    world.clear()
    base = ET.SubElement(world, "body", name="base", childclass="fr3")
    _add_visual(base, _ARM_RGBA, type="cylinder", size="0.075 0.02", pos="0 0 0.02")
    link = base
    for i in range(len(_LINKS)):
        link = _add_link(link, i)
    _make_2f85(hand)
    link.append(hand)
    return ET.tostring(tree, encoding="unicode")


def link_inertia(i: int) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Centre of mass (m) and inertia about it (kg m^2) of link i in the frame of its joint."""
    ends = (*UR5E_ARM.links[1:], ((0.0, 0.0, UR5E_ARM.flange_offset), 0.0))
    offset, twist = ends[i]  # of its Denavit-Hartenberg frame
    R = rotation_matrix(np.array([twist, 0.0, 0.0]))
    xx, yy, zz, xy, xz, yz = _LINKS[i].inertia
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return np.array(offset) + R @ np.array(_LINKS[i].centre), R @ inertia @ R.T


def _add_link(parent: ET.Element, i: int) -> ET.Element:
    (offset, twist), described = UR5E_ARM.links[i], _LINKS[i]
    turn = _text(np.cos(twist / 2), np.sin(twist / 2), 0, 0)
    link = ET.SubElement(parent, "body", name=f"ur5e_link{i + 1}", pos=_text(*offset), quat=turn)
    centre, inertia = link_inertia(i)
    ET.SubElement(
        link,
        "inertial",
        mass=_text(described.mass),
        pos=_text(*centre),
        fullinertia=_text(*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]),
    )
    ET.SubElement(
        link,
        "joint",
        name=f"ur5e_joint{i + 1}",
        axis="0 0 1",
        range=_text(UR5E_ARM.lower[i], UR5E_ARM.upper[i]),
        actuatorfrcrange=_text(-described.torque, described.torque),
        armature=_text(_ARMATURE[i]),
    )
    for start, end, radius in described.capsules:
        ends, size = _text(*start, *end), _text(radius)
        ET.SubElement(link, "geom", type="capsule", fromto=ends, size=size, rgba=_ARM_RGBA)
    return link


def _make_2f85(hand: ET.Element) -> None:
    """Turn the Franka Hand, whose fingers and joints keep their names, into a 2F-85."""
    tool = ROBOTIQ_2F85
    hand.set("pos", _text(0, 0, UR5E_ARM.flange_offset))
    hand.set("quat", _text(np.cos(UR5E_ARM.hand_yaw / 2), 0, 0, np.sin(UR5E_ARM.hand_yaw / 2)))
    for part in [*hand.findall("geom"), *hand.findall("inertial")]:
        hand.remove(part)
    carriage = tool.tcp_offset - SENSOR_BELOW_CARRIAGE
    mass = tool.mass - 2 * _FINGER_MASS
    # So that the whole has its centre of mass where the tool's is.
    z = (tool.mass * tool.centre_of_mass[2] - 2 * _FINGER_MASS * carriage) / mass
    depth, width, top = _BODY
    x2, y2, z2 = depth**2, width**2, (top / 2) ** 2
    inertia = mass / 3 * np.array([y2 + z2, x2 + z2, x2 + y2])  # of a box
    ET.SubElement(
        hand, "inertial", mass=_text(mass), pos=_text(0, 0, z), diaginertia=_text(*inertia)
    )
    radius, height = _COUPLING
    size, middle = _text(radius, height / 2), _text(0, 0, height / 2)
    _add_visual(hand, _GRIPPER_RGBA, type="cylinder", size=size, pos=middle)
    half = (top - height) / 2
    size, middle = _text(depth, width, half), _text(0, 0, height + half)
    ET.SubElement(hand, "geom", type="box", size=size, pos=middle, rgba=_GRIPPER_RGBA)
    for finger in hand.findall("body"):
        finger.set("pos", _text(0, 0, carriage))
        for inertial in finger.findall("inertial"):
            inertial.set("mass", _text(_FINGER_MASS))
            inertial.set("diaginertia", "3e-5 3e-5 1e-5")
        for joint in finger.findall("joint"):
            joint.set("range", _text(0, tool.stroke[1] / 2))


def _add_visual(body: ET.Element, rgba: str, **shape: str) -> None:
    """A shape that touches nothing."""
    ET.SubElement(body, "geom", {"contype": "0", "conaffinity": "0", "rgba": rgba, **shape})


def _text(*numbers: float) -> str:
    return " ".join(f"{number:.9g}" for number in numbers)
