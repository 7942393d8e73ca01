"""An episode: synchronised frames, a task in words, and facts about the whole."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from touchgoal.control import features as ft
from touchgoal.runtime.errors import UserError

MetaValue = str | int | float | bool | list[str]
CORRECTED = "corrected"
"""Outcome of an episode in which a policy acted while an expert's actions were recorded."""

INDEX_DTYPES = {  # which LeRobot adds to every frame, each a scalar of feature shape [1]
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


def is_image(key: str) -> bool:
    """Return whether a key holds images, of a camera or of a fingertip sensor."""
    return key.startswith(ft.IMAGE_PREFIX)


def is_camera(key: str) -> bool:
    """Return whether a key holds camera images, stored as video; tactile images are stored singly."""
    return is_image(key) and "tactile" not in key


@dataclass(frozen=True, eq=False)
class Episode:
    """One recorded attempt at a task.

    Attributes:
        frames: Key of `FEATURES` -> array (T, ...) in the key's dtype, one row per frame. Images are
            uint8 RGB (T, h, w, 3). Within a set, image sizes and the arm's number of joints are equal.
        task: Instruction in words.
        meta: Facts about the whole episode, such as object, seed and outcome; the same keys with the
            same types in every episode of a set.
    """

    frames: dict[str, np.ndarray]
    task: str
    meta: dict[str, MetaValue] = field(default_factory=dict)

    def __len__(self) -> int:
        return next((len(values) for values in self.frames.values()), 0)

    @property
    def features(self) -> dict[str, ft.Feature]:
        """`FEATURES` for this episode's arm; the length of its state, else its action, gives the joints."""
        for key, joints in ((ft.STATE, lambda n: (n - 1) // 2), (ft.ACTION, lambda n: n - 1)):
            if key in self.frames and self.frames[key].ndim == 2:
                return ft.features_of(joints(self.frames[key].shape[1]))
        return ft.features_of(ft.N_JOINTS)

    def check(self) -> None:
        """Raise UserError, naming the key, if a value cannot be stored without loss."""
        if not self.task.strip():
            raise UserError("an episode needs a task in words: its task is empty")
        if len(self) == 0:
            raise UserError("an episode needs at least one key and one frame: this one is empty")
        features = self.features
        for key, values in self.frames.items():
            _check_key(features, key, values)
            if len(values) != len(self):
                first = next(iter(self.frames))
                raise UserError(
                    f"{key} has {len(values)} frames but {first} has {len(self)}: record every "
                    "key at every tick"
                )
        for key, value in self.meta.items():
            _check_meta(key, value)


def _check_key(features: dict[str, ft.Feature], key: str, values: np.ndarray) -> None:
    if key not in features:
        raise UserError(f"{key!r} is no key of touchgoal; known keys: {', '.join(ft.FEATURES)}")
    feature = features[key]
    if values.dtype != feature.dtype:
        raise UserError(f"{key} has dtype {values.dtype}: convert it to {feature.dtype}")
    if is_image(key):
        _check_image_shape(key, values.shape)
    elif values.shape[1:] != feature.shape:
        raise UserError(f"{key} has shape {values.shape[1:]} per frame, not {feature.shape}")
    elif not np.isfinite(values).all():
        frame = int(np.argwhere(~np.isfinite(values))[0][0])
        raise UserError(f"{key} is not finite at frame {frame}: leave out what was not measured")


def _check_image_shape(key: str, shape: tuple[int, ...]) -> None:
    if len(shape) != 4 or shape[3] != 3 or 0 in shape:
        raise UserError(f"{key} has shape {shape}: images are (T, h, w, 3), RGB")
    # H.264 in yuv420p, as `write_video` writes it, shares one colour sample between 2 x 2 pixels.
    if is_camera(key) and (shape[1] % 2 or shape[2] % 2):
        raise UserError(f"{key} is {shape[1]} x {shape[2]}: a camera needs even height and width")


def _check_meta(key: str, value: Any) -> None:
    if isinstance(value, list):
        sound = all(isinstance(item, str) for item in value)
    else:
        sound = isinstance(value, str | int | float | bool)
    if not sound or not key:
        raise UserError(
            f"meta {key!r} is a {type(value).__name__}: use str, int, float, bool or a list of str"
        )
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise UserError(f"meta {key!r} is {value}, which does not fit in 64 bits: use a str")
    if isinstance(value, float) and not math.isfinite(value):
        raise UserError(f"meta {key!r} is {value}: leave out what is not known")


def describe_features(episode: Episode, fps: int) -> dict[str, dict[str, Any]]:
    """Return the `features` of LeRobot's meta/info.json for an episode, index columns included."""
    described = {}
    for key, feature in episode.features.items():
        if key not in episode.frames:
            continue
        shape = list(episode.frames[key].shape[1:])
        described[key] = {"dtype": feature.dtype, "shape": shape, "names": list(feature.names)}
        if is_camera(key):
            described[key] |= {"dtype": "video", "info": _video_info(shape, fps)}
        elif is_image(key):
            described[key]["dtype"] = "image"
    for key, dtype in INDEX_DTYPES.items():
        described[key] = {"dtype": dtype, "shape": [1], "names": None}
    return described


def _video_info(shape: list[int], fps: int) -> dict[str, Any]:
    return {
        "video.height": shape[0],
        "video.width": shape[1],
        "video.codec": "h264",
        "video.fps": fps,
        "video.channels": 3,
        "is_depth_map": False,
        "has_audio": False,
    }
