"""What a station's devices say in one control tick, in the vocabulary and with its age."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from touchgoal.control import features as ft
from touchgoal.control.cell.connection import Station
from touchgoal.control.errors import UserError
from touchgoal.control.interfaces import (
    ArmReading,
    DriverError,
    Frame,
    GripperReading,
    LoadReading,
    TactileSensor,
)
from touchgoal.control.motion.kinematics import GELSIGHT_TCP, Kinematics, rotation_vector
from touchgoal.control.tactile.indentation import IndentationMeter

_LOAD_AGE = 0.5  # s without a good line after which a load cell counts as silent


@dataclass(frozen=True)
class Sensed:
    """One tick.

    Attributes:
        observation: by the keys of `control/features.py`.
        age: s since the oldest picture was taken.
        oldest: whose picture that was.
        touch: m that the left and the right gel are pressed in; 0 without fingertips.
        fault: what a device says is wrong with it; empty if nothing.
    """

    observation: dict[str, np.ndarray]
    arm: ArmReading
    gripper: GripperReading
    load: LoadReading | None
    age: float
    oldest: str
    touch: Float[np.ndarray, "2"]
    fault: str


class StationReader:
    """Reads a station whose fingertips are untouched at first.

    It never waits: drivers keep the newest reading of everything.
    """

    def __init__(
        self, station: Station, camera_size: tuple[int, int] = ft.CAMERA_SHAPE[:2]
    ) -> None:
        """Gives cameras' pictures that size; UserError if one takes smaller ones."""
        self._station, self._size = station, camera_size
        for key, camera in station.cameras.items():
            taken = camera.read().image.shape[:2]
            if key not in ft.TACTILE and min(np.subtract(taken, camera_size)) < 0:
                raise UserError(
                    f"{key} takes pictures of {taken[0]} x {taken[1]}, {camera_size[0]} x "
                    f"{camera_size[1]} are needed: make them larger where the camera is set"
                )
        self._kinematics = Kinematics(station.robot.arm, GELSIGHT_TCP)
        self._meters = {
            key: IndentationMeter(camera.model, camera.read().image)
            for key, camera in station.cameras.items()
            if isinstance(camera, TactileSensor)
        }
        self._felt: dict[str, tuple[int, float]] = {}  # sequence of the last frame, indentation

    def look(self) -> Sensed:
        """The newest of everything; DriverError if something broke for good."""
        station = self._station
        arm, gripper = station.arm.read(), station.gripper.read()
        frames = {key: camera.read() for key, camera in station.cameras.items()}
        load = station.load_cell.read() if station.load_cell else None
        age = station.clock.age
        ages = {key: age(frame.stamp) for key, frame in frames.items()}
        if load and age(load.stamp) > _LOAD_AGE:
            ages["load cell"] = age(load.stamp)
        oldest = max(ages, key=ages.__getitem__) if ages else ""
        fault = f"arm: {arm.fault}" if arm.fault else ""
        fault = fault or (f"gripper: {gripper.fault}" if gripper.fault else "")
        observation = self._proprioception(arm, gripper)
        for key, frame in frames.items():
            tactile = key in ft.TACTILE
            observation[key] = frame.image if tactile else framed(frame.image, self._size)
        touch = self._touch(frames)
        return Sensed(observation, arm, gripper, load, ages.get(oldest, 0.0), oldest, touch, fault)

    def _touch(self, frames: dict[str, Frame]) -> Float[np.ndarray, "2"]:
        """Every picture is measured once: between two of them there is no news."""
        for key, meter in self._meters.items():
            frame = frames[key]
            if key not in self._felt or self._felt[key][0] != frame.sequence:
                self._felt[key] = frame.sequence, meter.measure(frame.image)
        return np.array([self._felt[key][1] if key in self._felt else 0.0 for key in ft.TACTILE])

    def trouble(self) -> str:
        """What the cameras say is wrong with them, for a report."""
        found = []
        for key, camera in self._station.cameras.items():
            try:
                trouble = camera.trouble
            except DriverError as error:
                trouble = str(error)
            if trouble:
                found.append(f"{key.removeprefix(ft.IMAGE_PREFIX)}: {trouble}")
        return "; ".join(found)

    def _proprioception(self, arm: ArmReading, gripper: GripperReading) -> dict[str, np.ndarray]:
        position, R = self._kinematics.forward(arm.q)
        values = {
            ft.STATE: np.concatenate([arm.q, arm.velocity, [gripper.width]]),
            ft.TCP_POSE: np.concatenate([position, quaternion(R)]),
            ft.WRENCH: arm.wrench,
        }
        return {key: value.astype(np.float32) for key, value in values.items()}


def quaternion(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Rotation as wxyz, its largest component positive, as MuJoCo has it."""
    vector = rotation_vector(R)
    angle = float(np.linalg.norm(vector))
    q = np.append(np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * vector)
    return q * np.sign(q[np.argmax(np.abs(q))])


def framed(image: UInt8[np.ndarray, "h w 3"], shape: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """The middle of a picture, in the proportions and at the size (rows, columns) of `shape`."""
    rows, columns = shape
    height, width = image.shape[:2]
    if (height, width) == shape:
        return image
    scale = min(height / rows, width / columns)
    h, w = round(rows * scale), round(columns * scale)
    top, left = (height - h) // 2, (width - w) // 2
    middle = np.ascontiguousarray(image[top : top + h, left : left + w])
    return cv2.resize(middle, (columns, rows), interpolation=cv2.INTER_AREA)
