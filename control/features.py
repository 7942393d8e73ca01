"""Names, shapes and units of everything observed, commanded and recorded.

The same keys name a quantity in the simulator, on the real arm, in an episode file and in a
policy's input. SI units (metres, radians, newtons, seconds); quaternions are wxyz; the base frame
is the robot's first link. Keys follow LeRobot's naming.
"""

from dataclasses import dataclass

import numpy as np

Observation = dict[str, np.ndarray]
"""One tick's observation: key -> array."""


def read_only(observation: Observation) -> Observation:
    """Return views of the arrays that cannot be written to; nothing is copied."""
    views = {key: value.view() for key, value in observation.items()}
    for view in views.values():
        view.flags.writeable = False
    return views


STATE = "observation.state"
COMMAND = "observation.command"
TCP_POSE = "observation.tcp_pose"
WRENCH = "observation.wrench"
LOAD = "observation.load"
AGE = "observation.age"
FRONT = "observation.images.front"
WRIST = "observation.images.wrist"
WAND_VIEWS = tuple(
    f"observation.images.{view}" for view in ("top", "side_left", "side_right", "wand")
)
TACTILE_LEFT = "observation.images.tactile_left"
TACTILE_RIGHT = "observation.images.tactile_right"
ACTION = "action"
COST = "cost"  # in deployed episodes whose cell file names a goal

TACTILE = (TACTILE_LEFT, TACTILE_RIGHT)
CAMERAS = (FRONT, WRIST)
IMAGE_PREFIX = "observation.images."

# Known to a simulator alone.
TRUTH_PAD_WRENCH = "truth.pad_wrench"
TRUTH_CONTACT = "truth.contact"
TRUTH_SLIP = "truth.slip"
TRUTH_OBJECT_POSE = "truth.object_pose"
TRUTH_START = "truth.start"  # of pick-and-place
TRUTH_PROGRESS = "truth.progress"
TRUTH_SUCCESS = "truth.success"
TRUTH_FAILURE = "truth.failure"  # of tasks that can fail before their time is up

N_JOINTS = 7  # of an FR3, which policies are made for; see `features_of` for other arms
CONTROL_HZ = 20
TACTILE_SHAPE = (240, 320, 3)
CAMERA_SHAPE = (128, 128, 3)

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_WRENCH = ("fx", "fy", "fz", "tx", "ty", "tz")


@dataclass(frozen=True)
class Feature:
    """One recorded or observed quantity: numpy dtype name, shape of one sample, component names."""

    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...]
    meaning: str


_IMAGE_NAMES = ("height", "width", "channels")


def features_of(joints: int) -> dict[str, Feature]:
    """Return every feature of an arm with this many joints: 7 for an FR3, 6 for a UR5e."""
    names = [f"joint_{i}" for i in range(1, joints + 1)]
    moving = *(f"{j}.pos" for j in names), *(f"{j}.vel" for j in names)
    state = "joint positions (rad), joint velocities (rad/s), gripper width (m)"
    command = "commanded joint positions (rad) and their change in the last tick (rad/s)"
    command += ", without delay or contact"
    action = "joint change for this control tick (rad), gripper width target (m)"
    targets = *(f"{j}.delta" for j in names), "gripper.target"
    return {
        STATE: Feature("float32", (2 * joints + 1,), (*moving, "gripper.pos"), state),
        COMMAND: Feature("float32", (2 * joints,), moving, command),
        TCP_POSE: Feature("float32", (7,), _POSE, "tool centre point in the base frame: m, wxyz"),
        WRENCH: Feature(
            "float32", (6,), _WRENCH, "external force (N) and torque (Nm) at the TCP, base frame"
        ),
        LOAD: Feature(
            "float32", (1,), ("fz",), "force on the table's load cell, N; where there is one"
        ),
        AGE: Feature("float32", (1,), ("age",), "age of its oldest measurement, s"),
        FRONT: Feature("uint8", CAMERA_SHAPE, _IMAGE_NAMES, "fixed camera facing the robot, RGB"),
        WRIST: Feature("uint8", CAMERA_SHAPE, _IMAGE_NAMES, "camera on the hand, RGB"),
        **{
            key: Feature(
                "uint8", (224, 224, 3), _IMAGE_NAMES, "camera of the touch wand's bench, RGB"
            )
            for key in WAND_VIEWS
        },
        TACTILE_LEFT: Feature("uint8", TACTILE_SHAPE, _IMAGE_NAMES, "left fingertip sensor, RGB"),
        TACTILE_RIGHT: Feature("uint8", TACTILE_SHAPE, _IMAGE_NAMES, "right fingertip sensor, RGB"),
        ACTION: Feature("float32", (joints + 1,), targets, action),
        COST: Feature(
            "float32",
            (1,),
            ("cost",),
            "distance to the goal as measured in the run: 1 at the usual start, 0 at the usual end",
        ),
        TRUTH_PAD_WRENCH: Feature(
            "float32",
            (12,),
            tuple(f"{side}.{n}" for side in ("left", "right") for n in _WRENCH),
            "force (N) and torque (Nm) of the object on each pad, pad frame (z out of the gel)",
        ),
        TRUTH_CONTACT: Feature("bool", (2,), ("left", "right"), "pad touches something"),
        TRUTH_SLIP: Feature("bool", (2,), ("left", "right"), "pad contact slides"),
        TRUTH_OBJECT_POSE: Feature("float32", (7,), _POSE, "object in the base frame: m, wxyz"),
        TRUTH_START: Feature(
            "float32",
            (7,),
            ("x", "y", "z", "cos_2yaw", "sin_2yaw", "goal.x", "goal.y"),
            "as the episode begins, base frame: the object (m), the hand's yaw to grasp it, the goal "
            "(m); twice the yaw, as half a turn changes nothing between two fingers",
        ),
        TRUTH_PROGRESS: Feature("float32", (1,), ("progress",), "task progress in [0, 1]"),
        TRUTH_SUCCESS: Feature("bool", (1,), ("success",), "task done"),
        TRUTH_FAILURE: Feature(
            "bool", (3,), ("drop", "jam", "over_force"), "object lost, stuck, pressed too hard"
        ),
    }


FEATURES = features_of(N_JOINTS)
