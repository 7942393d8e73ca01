"""A UR5e in place of the FR3: its published kinematics in capsules, with the same hand and pads.

No wheel ships a UR5e model, so this one is built from Universal Robots' Denavit-Hartenberg table
(`control.kinematics`), masses and joint torques; its shape is only as true as capsules can be.
"""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from touchgoal.control.motion.arm_models import UR5E_ARM

# kg; Universal Robots' DH page (article 45257). Inertia follows from the capsules.
_MASSES = (3.761, 8.058, 2.846, 1.37, 1.3, 0.365)
# N m; Universal_Robots_ROS2_Description ur5e/joint_limits.yaml.
_TORQUES = (150, 150, 150, 28, 28, 28)
# Capsules of each link: (start, end, radius) in m, in the frame of the link's joint. The upper arm
# runs 138 mm beside the shoulder's axis, the forearm 7 mm (UR5e drawing); radii are ours.
_CAPSULES = (
    (((0, 0, 0.04), (0, 0, 0.16), 0.06),),
    (((0, 0, 0.02), (0, 0, 0.138), 0.06), ((0, 0, 0.138), (-0.425, 0, 0.138), 0.054)),
    (((0, 0, 0.12), (0, 0, 0.007), 0.05), ((0, 0, 0.007), (-0.392, 0, 0.007), 0.043)),
    (((0, 0, 0.02), (0, 0, 0.133), 0.042),),
    (((0, 0, 0.02), (0, 0, 0.0997), 0.042),),
    (((0, 0, 0.05), (0, 0, 0.06), 0.0375),),
)
_ARMATURE = (0.2, 0.2, 0.2, 0.1, 0.1, 0.1)  # kg m^2, of rotor and gear: our choice

_RGBA = "0.72 0.76 0.8 1"


def replace_arm_with_ur5e(franka: Path) -> str:
    """MJCF of the model in `franka`, its arm replaced by a UR5e that carries the same hand."""
    tree = ET.parse(franka).getroot()
    world, hand = tree.find("worldbody"), tree.find(".//body[@name='hand']")
    assert world is not None and hand is not None
    for named in ("actuator", "contact"):  # of the FR3's own joints and links
        for part in tree.findall(named):
            tree.remove(part)
    world.clear()
    base = ET.SubElement(world, "body", name="base", childclass="fr3")
    ET.SubElement(
        base,
        "geom",
        type="cylinder",
        size="0.075 0.02",
        pos="0 0 0.02",
        contype="0",
        conaffinity="0",
        rgba=_RGBA,
    )
    link = base
    for i in range(len(_MASSES)):
        link = _add_link(link, i)
    hand.set("pos", _text(0, 0, UR5E_ARM.flange_offset))
    hand.set("quat", _text(np.cos(UR5E_ARM.hand_yaw / 2), 0, 0, np.sin(UR5E_ARM.hand_yaw / 2)))
    link.append(hand)
    return ET.tostring(tree, encoding="unicode")


def _add_link(parent: ET.Element, i: int) -> ET.Element:
    offset, twist = UR5E_ARM.links[i]
    turn = _text(np.cos(twist / 2), np.sin(twist / 2), 0, 0)
    link = ET.SubElement(parent, "body", name=f"ur5e_link{i + 1}", pos=_text(*offset), quat=turn)
    ET.SubElement(
        link,
        "joint",
        name=f"ur5e_joint{i + 1}",
        axis="0 0 1",
        range=_text(UR5E_ARM.lower[i], UR5E_ARM.upper[i]),
        actuatorfrcrange=_text(-_TORQUES[i], _TORQUES[i]),
        armature=_text(_ARMATURE[i]),
    )
    for start, end, radius in _CAPSULES[i]:
        ET.SubElement(
            link,
            "geom",
            type="capsule",
            fromto=_text(*start, *end),
            size=_text(radius),
            mass=_text(_MASSES[i] / len(_CAPSULES[i])),
            rgba=_RGBA,
        )
    return link


def _text(*numbers: float) -> str:
    return " ".join(f"{number:.9g}" for number in numbers)
