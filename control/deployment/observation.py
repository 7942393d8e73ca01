"""Observation of one control tick from a cell's devices, with its age."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from touchgoal.control import features as ft
from touchgoal.control.arrays import Image
from touchgoal.control.cell.connection import CellConnection
from touchgoal.control.interfaces import ArmReading, DriverError, Frame, GripperReading
from touchgoal.control.motion.rotations import rotation_vector
from touchgoal.control.safety.fingertip_health import FingertipHealth
from touchgoal.control.tactile.indentation import IndentationMeter
from touchgoal.runtime.errors import UserError

_MAX_LOAD_CELL_AGE = 0.5  # s without a good line after which a load cell counts as silent


@dataclass(frozen=True)
class CellReading:
    """Readings of one tick."""

    observation: dict[str, np.ndarray]  # by the keys of `control/features.py`
    # arm, gripper: the last readings without NaN, with their own stamps, so that ages show it
    arm: ArmReading
    gripper: GripperReading
    added_load: float  # on the load cell since the first reading, N; 0 without one
    age: float  # of the oldest image, s
    oldest_source: str  # source of that image
    indentation: Float[np.ndarray, "2"]  # depth in left and right gel, m; 0 without fingertips
    fault: str  # a device's own report of a fault; empty if none


class ObservationReader:
    """Reader of a connection whose fingertips are untouched at first; it never waits for a device."""

    def __init__(
        self, connection: CellConnection, camera_size: tuple[int, int] = ft.CAMERA_SHAPE[:2]
    ) -> None:
        """Resize camera images to that size (rows, columns); UserError if one takes smaller ones."""
        self._connection, self._size = connection, camera_size
        for key, camera in connection.cameras.items():
            taken = camera.read().image.shape[:2]
            if key not in ft.TACTILE and min(np.subtract(taken, camera_size)) < 0:
                raise UserError(
                    f"{key} takes images of {taken[0]} x {taken[1]}, {camera_size[0]} x "
                    f"{camera_size[1]} are needed: make them larger where the camera is set"
                )
        robot = connection.robot
        self._kinematics = robot.kinematics()
        tips = connection.fingertips
        self._health = {key: FingertipHealth(tip.model) for key, tip in tips.items()}
        for key, tip in tips.items():
            if wrong := self._health[key].fault(tip.read().image):
                raise UserError(f"{key.removeprefix(ft.IMAGE_PREFIX)}: {wrong}")
        self._meters = {
            key: IndentationMeter(tip.model, tip.read().image) for key, tip in tips.items()
        }
        self.has_fingertips = bool(self._meters)  # whether `indentation` is measured
        self._indentations: dict[str, tuple[int, float]] = {}  # frame's sequence, depth (m)
        self._arm: ArmReading | None = None
        self._gripper: GripperReading | None = None
        self._first_load: float | None = None
        self.unsound = ""  # values of the newest arm and gripper readings that are not numbers

    def read(self) -> CellReading:
        """Return the newest readings; DriverError if a device broke for good."""
        connection = self._connection
        arm, gripper = self._without_nan(connection.arm.read(), connection.gripper.read())
        frames = {key: camera.read() for key, camera in connection.cameras.items()}
        load = connection.load_cell.read() if connection.load_cell else None
        ages = {key: connection.clock.age(frame.stamp) for key, frame in frames.items()}
        if load and (silent := connection.clock.age(load.stamp)) > _MAX_LOAD_CELL_AGE:
            ages["load cell"] = silent
        oldest = max(ages, key=ages.__getitem__) if ages else ""
        fault = f"arm: {arm.fault}" if arm.fault else ""
        fault = fault or (f"gripper: {gripper.fault}" if gripper.fault else "")
        observation = self.proprioception(arm, gripper)
        added_load = 0.0
        if load is not None:
            observation[ft.LOAD] = np.array([load.force], np.float32)
            self._first_load = load.force if self._first_load is None else self._first_load
            added_load = load.force - self._first_load
        for key, frame in frames.items():
            tactile = key in ft.TACTILE
            observation[key] = frame.image if tactile else crop_and_resize(frame.image, self._size)
        age, (indentation, wrong) = ages.get(oldest, 0.0), self._indentation(frames)
        fault = fault or wrong
        return CellReading(observation, arm, gripper, added_load, age, oldest, indentation, fault)

    def _without_nan(
        self, arm: ArmReading, gripper: GripperReading
    ) -> tuple[ArmReading, GripperReading]:
        """Return the newest readings without NaN; faults are always the newest."""
        parts = {
            "joint positions": arm.q,
            "joint velocity": arm.velocity,
            "joint torque": arm.torque,
        }
        bad = [name for name, value in parts.items() if not np.isfinite(value).all()]
        if not bad or self._arm is None:
            self._arm = arm
        narrow = [] if np.isfinite(gripper.width) else ["gripper width"]
        if not narrow or self._gripper is None:
            self._gripper = gripper
        self.unsound = f"{' and '.join(bad + narrow)} not a number" if bad or narrow else ""
        if not np.isfinite(self._arm.q).all():
            raise DriverError("the arm's joint positions are not numbers: restart its controller")
        return replace(self._arm, fault=arm.fault), replace(self._gripper, fault=gripper.fault)

    def _indentation(self, frames: dict[str, Frame]) -> tuple[Float[np.ndarray, "2"], str]:
        """Return the depth in both gels, and a fingertip's fault; every image is measured once."""
        fault = ""
        for key, meter in self._meters.items():
            frame = frames[key]
            if key not in self._indentations or self._indentations[key][0] != frame.sequence:
                if wrong := self._health[key].update(frame.image):
                    fault = f"{key.removeprefix(ft.IMAGE_PREFIX)}: {wrong}"
                before = self._indentations.get(key, (0, 0.0))[1]
                doubtful = self._health[key].doubtful
                depth = before if doubtful else meter.measure(frame.image)
                self._indentations[key] = frame.sequence, depth
        depths = [self._indentations[k][1] if k in self._indentations else 0.0 for k in ft.TACTILE]
        return np.array(depths), fault

    def problem(self) -> str:
        """Return the cameras' own reports of problems."""
        found = []
        for key, camera in self._connection.cameras.items():
            try:
                problem = camera.problem
            except Exception as error:  # of any driver
                problem = str(error)
            if problem:
                found.append(f"{key.removeprefix(ft.IMAGE_PREFIX)}: {problem}")
        return "; ".join(found)

    def proprioception(self, arm: ArmReading, gripper: GripperReading) -> dict[str, np.ndarray]:
        """Return state, TCP pose and wrench by their keys."""
        position, R = self._kinematics.forward(arm.q)
        values = {
            ft.STATE: np.concatenate([arm.q, arm.velocity, [gripper.width]]),
            ft.TCP_POSE: np.concatenate([position, quaternion(R)]),
            ft.WRENCH: arm.wrench,
        }
        return {key: value.astype(np.float32) for key, value in values.items()}


def quaternion(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Return a rotation as wxyz, its largest component positive, as in MuJoCo."""
    vector = rotation_vector(R)
    angle = float(np.linalg.norm(vector))
    q = np.append(np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * vector)
    return q * np.sign(q[np.argmax(np.abs(q))])


def crop_and_resize(image: Image, shape: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """Return the middle of an image, in the proportions and at the size (rows, columns) of `shape`."""
    rows, columns = shape
    height, width = image.shape[:2]
    if (height, width) == shape:
        return image
    scale = min(height / rows, width / columns)
    h, w = round(rows * scale), round(columns * scale)
    top, left = (height - h) // 2, (width - w) // 2
    middle = np.ascontiguousarray(image[top : top + h, left : left + w])
    return cv2.resize(middle, (columns, rows), interpolation=cv2.INTER_AREA)
