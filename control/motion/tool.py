"""The tool of an arm: a parallel gripper with a fingertip sensor on each finger.

The hand frame lies at the flange, turned by `ArmModel.hand_yaw`: z out of the flange, the fingers
close along y.
"""

from dataclasses import dataclass

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Tool:
    """A gripper with its sensors."""

    name: str  # for messages
    # m from the flange to the tool centre point, midway between the two gels' centres, along the
    # hand's z axis
    tcp_offset: float
    stroke: tuple[float, float]  # m, least and greatest width between the gels
    speed: float  # m/s of width, the gripper's fastest
    force: tuple[float, float]  # N, least and greatest grasp force that can be set
    mass: float  # kg, beyond the flange; the sensors' is unpublished and not included
    centre_of_mass: Point  # m, hand frame
    finger_corners: tuple[Point, ...]  # m, hand frame: of a box around the open fingertips


def _corners(tcp_offset: float, half_stroke: float) -> tuple[Point, ...]:
    """Return a box around the GelSight Minis on two open fingers (GelSight's STEP file), rounded up.

    A Mini is 28.5 mm wide; its outer face is 28.3 mm behind the gel, its ends half of 32.5 mm from the
    gel's centre.
    """
    across, side, half = 0.0145, half_stroke + 0.03, 0.0165
    return tuple(
        (x, y, z)
        for x in (across, -across)
        for y in (side, -side)
        for z in (tcp_offset + half, tcp_offset - half)
    )


# m from a finger's carriage to the sensor's centre: the adapter's bolt axis is 12 mm below the carriage
# (read off the Franka finger mesh's bolt recess), the sensor's centre 67 mm below the bolts (GelSight's
# Panda adapter STEP file).
SENSOR_BELOW_CARRIAGE = 0.012 + 0.067
_FRANKA_TCP = 0.0584 + SENSOR_BELOW_CARRIAGE  # carriage 58.4 mm below the hand frame: fr3.xml

FRANKA_HAND = Tool(
    "Franka Hand with two GelSight Minis",
    tcp_offset=_FRANKA_TCP,
    stroke=(0.0, 0.08),  # stroke, speed, force: Franka Hand's manual; mass, its centre: fr3.xml
    speed=0.1,
    force=(30.0, 70.0),
    mass=0.76,
    centre_of_mass=(-0.01, 0.0, 0.03),
    finger_corners=_corners(_FRANKA_TCP, 0.04),
)

# The maker's dimensions: coupling 10.8 mm; fingertips end 162.8 mm above the gripper's base when closed
# (13 mm less when open: they go round on 57.5 mm links, here they are taken to slide straight at
# their closed height). The middle of the 37.5 mm long fingertip is where a sensor's centre is taken
# to be, its gel in the fingertip's face: measure your own mount.
_ROBOTIQ_TCP = 0.0108 + 0.1628 - 0.0375 / 2

ROBOTIQ_2F85 = Tool(
    "Robotiq 2F-85 with two GelSight Minis",
    tcp_offset=_ROBOTIQ_TCP,
    # Stroke, speed, force and mass with coupling: Robotiq's instruction manual, 6.1. Centre of mass:
    # of MuJoCo Menagerie's robotiq_2f85, whose parts weigh 0.900 kg, and a coupling of 25 g.
    stroke=(0.0, 0.085),
    speed=0.15,
    force=(20.0, 235.0),
    mass=0.925,
    centre_of_mass=(0.0, 0.0, 0.052),
    finger_corners=_corners(_ROBOTIQ_TCP, 0.0425),
)
