"""Recordings of ROS: a rosbag2 folder, an MCAP or .db3 file, a bag of ROS 1. One bag is one episode.

A stream is called as its topic; joint states are three, TOPIC.position, .velocity and .effort. A sample's
time is the message's own (`header.stamp`), else that of its recording.
"""

from collections import defaultdict
from collections.abc import Iterator
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from touchgoal.episodes.importers.streams import RawEpisode, Stream
from touchgoal.runtime.errors import UserError, install_extra
from touchgoal.runtime.image_file import decode_image

SUFFIXES = (".bag", ".db3", ".mcap")
_TO_RGB = {
    "rgb8": None,
    "bgr8": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB,
}
_XYZ = ("x", "y", "z")
_POSE = tuple(f"position.{n}" for n in _XYZ) + tuple(f"orientation.{n}" for n in (*_XYZ, "w"))
_WRENCH = tuple(f"force.{n}" for n in _XYZ) + tuple(f"torque.{n}" for n in _XYZ)
_MOVED = tuple(
    n.replace("position", "translation").replace("orientation", "rotation") for n in _POSE
)
_FIELDS = {  # by the end of the message type: numbers in the message, and how their components are called
    "/PoseStamped": ("pose", _POSE),
    "/Pose": ("", _POSE),
    "/TransformStamped": ("transform", _MOVED),
    "/WrenchStamped": ("wrench", _WRENCH),
    "/Wrench": ("", _WRENCH),
}
_SCALARS = ("/Float32", "/Float64", "/Int32", "/Int64", "/Bool")
_ARRAYS = ("/Float32MultiArray", "/Float64MultiArray")
_PICTURES = ("/Image", "/CompressedImage")


def read_bag(path: Path) -> RawEpisode:
    """Read what a bag holds: numbers at once, images when they are asked for.

    UserError: no bag, or nothing in it that can be read.
    """
    times: dict[str, list[float]] = defaultdict(list)
    values: dict[str, list[np.ndarray]] = defaultdict(list)
    names: dict[str, tuple[str, ...]] = {}
    shapes: dict[str, tuple[int, ...]] = {}
    for topic, kind, stamp, message in _messages(path):
        if kind.endswith(_PICTURES):
            if topic not in shapes and (image := _image(message, topic)) is not None:
                shapes[topic] = image.shape
            times[topic].append(stamp)
            continue
        for name, (numbers, parts) in _numbers(topic, kind, message).items():
            times[name].append(stamp)
            values[name].append(numbers)
            names[name] = parts
    streams = {}
    for name, of_name in times.items():
        order = np.argsort(of_name, kind="stable")
        at = np.array(of_name)[order]
        if name in shapes:
            read = partial(_read_images, path, name, order)
            streams[name] = Stream(at, shapes[name], read)
        # a joint state that changes its joints is none
        elif len({v.shape for v in values[name]}) == 1:
            rows = np.stack(values[name])[order]
            streams[name] = Stream(at, rows.shape[1:], rows.__getitem__, names[name])
    if not streams:
        raise UserError(f"{path} holds no images, joint states, poses, wrenches or numbers")
    return RawEpisode(path.stem, streams)


def _messages(path: Path, only: str = "") -> Iterator[tuple[str, str, float, Any]]:
    """Yield topic, type, time (s) and message of what is read, in the order of the recording."""
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise UserError(f"{path.name} needs {install_extra('import')}") from None
    usual = get_typestore(Stores.ROS2_HUMBLE)  # of bags without definitions, such as older rosbag2
    try:
        with AnyReader([path], default_typestore=usual) as reader:
            links = [c for c in reader.connections if _is_read(c.msgtype)]
            wanted = [c for c in links if c.topic == only or not only]
            for link, logged, data in reader.messages(wanted) if wanted else ():
                message = reader.deserialize(data, link.msgtype)
                stamp = getattr(getattr(message, "header", None), "stamp", None)
                own = stamp.sec + 1e-9 * stamp.nanosec if stamp is not None else 0.0
                yield link.topic, link.msgtype, own or 1e-9 * logged, message
    except AnyReaderError as error:
        raise UserError(f"{path} cannot be read as a bag: {error}") from error


def _is_read(kind: str) -> bool:
    return kind.endswith((*_FIELDS, *_SCALARS, *_ARRAYS, *_PICTURES, "/JointState"))


def _numbers(topic: str, kind: str, message: Any) -> dict[str, tuple[np.ndarray, tuple[str, ...]]]:
    """Return the numbers of a message by stream, with the names of the components."""
    if kind.endswith("/JointState"):
        joints = tuple(message.name)
        parts = {
            n: np.array(getattr(message, n), float) for n in ("position", "velocity", "effort")
        }
        return {f"{topic}.{n}": (v, joints) for n, v in parts.items() if len(v)}
    if kind.endswith(_SCALARS + _ARRAYS):
        return {topic: (np.array(message.data, float, ndmin=1), ())}
    inside, parts = next(v for end, v in _FIELDS.items() if kind.endswith(end))
    part = getattr(message, inside) if inside else message
    return {topic: (np.array([attrgetter(name)(part) for name in parts]), parts)}


def _image(message: Any, topic: str) -> UInt8[np.ndarray, "h w 3"] | None:
    """Return a message's image, RGB; None if it is none of 8 bits."""
    if not hasattr(message, "encoding"):
        is_depth = message.format.startswith(("16UC1", "32FC1"))  # "16UC1; png compressed"
        return None if is_depth else decode_image(bytes(message.data), topic)
    if message.encoding not in _TO_RGB:
        return None
    rows = np.asarray(message.data).reshape(message.height, message.step)
    channels = {"mono8": 1, "rgb8": 3, "bgr8": 3}.get(message.encoding, 4)
    image = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    code = _TO_RGB[message.encoding]
    return np.ascontiguousarray(image) if code is None else np.asarray(cv2.cvtColor(image, code))


def _read_images(
    path: Path, topic: str, order: np.ndarray, rows: np.ndarray
) -> UInt8[np.ndarray, "k h w 3"]:
    wanted = {int(number): row for row, number in enumerate(order[rows])}
    images = np.empty(0, np.uint8)
    for number, (_, _, _, message) in enumerate(_messages(path, topic)):
        if number not in wanted:
            continue
        if (image := _image(message, topic)) is None:
            raise UserError(f"{path}: image {number} of {topic} cannot be decoded")
        images = images if images.size else np.empty((len(rows), *image.shape), np.uint8)
        images[wanted[number]] = image
    return images
