"""Embedded episodes and goals: one array for each part, everything that a distance is computed from.

    front, wrist    (n, d)         pooled features of the camera of that name, unit vectors
    front_map, ...  (n, c, y, x)   its feature map at stride 16, float16
    touch           (n, sides, k)  touch embedding
    held            (n, sides)     whether the fingertip touches
    force           (n, sides)     normal force, N; 0 without contact
    centre          (n, sides, 2)  centre of the contact, m from the image's middle, x and y
    slip            (n, sides)     m, see `SlipMeter`
    wrench          (n, 6)         external force N and torque Nm, base frame
    tcp_pose        (n, 7)         xyz m, quaternion wxyz, base frame
    image           (n, d)         pooled features of the measured camera; or a sentence as its goal
    text            (n, k)         sentence, comparable with touch

Without parts there are image and touch alone. Force, centre and slip need a sensor with a file.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float32

from touchgoal.control.features import IMAGE_PREFIX, TCP_POSE, WRENCH
from touchgoal.episodes.schema import MetaValue
from touchgoal.rewards.curves import Contact
from touchgoal.rewards.distance.normalizer import EmbeddingSource
from touchgoal.rewards.goals import MODALITIES, Modality
from touchgoal.runtime.atomic_write import atomic_write

Features = Mapping[str, np.ndarray]
"""Arrays by part, frames (or goals) first."""

IMAGE, TOUCH, TEXT = "image", "touch", "text"
FINGERTIPS = (TOUCH, "held", "force", "centre", "slip")
"""Parts with an axis of fingertips."""
ARM = {"wrench": WRENCH, "tcp_pose": TCP_POSE}
"""Parts that the arm measures, and their keys."""
PUT_DOWN, SCENE_MAP = "put_down", "scene_map"
"""Of goals: whether what was held was put down, (n,); wrist_map of successes with any object."""
CARRIED = {name: f"carried_{name}" for name in (TOUCH, "held", "slip")}
"""Of goals whose hands end empty: what successes felt before the put-down, by what it stands for."""
_TOUCHED = (*FINGERTIPS, *ARM, PUT_DOWN, *CARRIED.values())  # parts that the goal of touch sets
_MAP = "_map"


@dataclass(frozen=True, eq=False)
class EmbeddedEpisode:
    """One embedded trajectory; its distance to a goal is then a dot product per frame."""

    features: Features
    made_with: EmbeddingSource  # encoders and sensors; embeddings of others cannot be compared
    source: str  # name of the trajectory, for people
    fps: float  # frames per second
    sides: tuple[str, ...] = ()  # keys of the fingertips that have touch embeddings
    contact: Contact = Contact(None, "not looked for")
    object: str = ""  # catalogue id of the object, "" if unknown
    success: bool | None = None  # whether the episode reached its goal, None if unknown
    # unit embeddings of the sentences about its object; empty without any, or if not requested
    descriptions: Float32[np.ndarray, "m k"] = field(
        default_factory=lambda: np.zeros((0, 0), np.float32)
    )

    def __len__(self) -> int:
        return len(next(iter(self.features.values())))

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """Modalities that a normalizer can be fitted to."""
        there = (IMAGE in self.features, TOUCH in self.features, len(self.descriptions) > 0)
        return tuple(name for name, known in zip(MODALITIES, there, strict=False) if known)

    def with_facts(self, meta: Mapping[str, MetaValue]) -> "EmbeddedEpisode":
        """Return the trajectory with the object and the outcome that its meta name."""
        success = meta.get("success")
        known = None if success is None else bool(success)
        return replace(self, object=str(meta.get("object", "")), success=known)

    def take(self, rows: slice | np.ndarray) -> "EmbeddedEpisode":
        """Return the trajectory with some of its frames; its first contact stays as it was."""
        return replace(self, features=take_rows(self.features, rows))


@dataclass(frozen=True, eq=False)
class EmbeddedGoal:
    """Goals of a trajectory as features, one or several for each modality that has any.

    The nearest of several counts most (`soft_minimum`).
    """

    features: Features
    forms: Mapping[str, str] = field(default_factory=dict)  # by modality, as a user writes them
    # modalities whose goal is the trajectory's own frame
    same_episode: frozenset[str] = frozenset()


def take_rows(features: Features, rows: slice | np.ndarray) -> Features:
    """Return the features of some frames."""
    return {name: values[rows] for name, values in features.items()}


def join_rows(pieces: Sequence[Features]) -> Features:
    """Return the features of several pieces, one after the other."""
    if len(pieces) == 1:
        return pieces[0]
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


def last_rows(episodes: Iterable[EmbeddedEpisode]) -> Features:
    """Return the features of the last frame of each of some episodes that were embedded alike."""
    return join_rows([take_rows(e.features, slice(-1, None)) for e in episodes])


def split_features(features: Features) -> tuple[Features, Features]:
    """Return the features that a goal of images sets, and those that a goal of touch sets."""
    touched = {name: values for name, values in features.items() if name in _TOUCHED}
    return {k: v for k, v in features.items() if k not in _TOUCHED}, touched


def cameras_of(features: Features) -> list[str]:
    """Return the names of the cameras that have pooled features of their own."""
    others = (IMAGE, TEXT, *_TOUCHED)
    return [name for name in features if name not in others and not name.endswith(_MAP)]


def camera_name(key: str) -> str:
    """Return the part of a camera: "wrist" for "observation.images.wrist"."""
    return key.removeprefix(IMAGE_PREFIX)


def map_name(camera: str) -> str:
    """Return the part that is the feature map of a camera, by its key or name."""
    return camera_name(camera) + _MAP


def save_features(path: Path, features: Features, about: Mapping[str, Any]) -> None:
    """Write features, and facts as JSON, to an npz file, atomically."""
    with atomic_write(path) as unfinished, unfinished.open("wb") as file:
        arrays: dict[str, Any] = dict(features)
        np.savez(file, about=np.array(json.dumps(about)), **arrays)


def load_features(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read what `save_features` wrote; ValueError: it is another file, or damaged."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            features = dict(stored)
        return features, json.loads(str(features.pop("about")))
    except (OSError, KeyError, TypeError, BadZipFile) as error:
        raise ValueError(f"{path} holds no features") from error
