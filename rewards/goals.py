"""Goals of a trajectory, and the modality that each one applies to; docs/rewards.md has the forms.

Four modalities: "image" (camera image to goal image), "tactile" (touch to goal touch), "text"
(touch to goal sentence) and "force" (grip force to newtons, in place of the goal touch's). Each takes
the first goal that applies; one that none takes is an error.
Without touch, and with towers that were trained together (a CLIP), a sentence is a goal for images.
"""

import hashlib
import math
import re
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from jaxtyping import UInt8

from touchgoal.control import features as ft
from touchgoal.encoders.preprocess import check_images
from touchgoal.encoders.towers.goal_sentence import check_goal_sentence
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet
from touchgoal.episodes.touches import touch_background
from touchgoal.rewards.metrics import START_FRAMES
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import read_image

Modality = Literal["image", "tactile", "text", "force"]
MODALITIES: tuple[Modality, ...] = ("image", "tactile", "text", "force")

FORMS = "last, frame:K, image:PATH, episode:ROOT#K, bank:SET, goal:FILE, text:SENTENCE or force:N"
_SMALLEST = 16  # px, the smallest camera image that the environments take


@dataclass(frozen=True)
class Inputs:
    """Everything known about trajectories before they are read."""

    name: str  # name for messages; of several trajectories the shortest
    camera: str | None  # key of the camera; "" for a plain video, None without images
    sides: tuple[str, ...] = ()  # keys of the fingertips with tactile images
    sensor: str | None = None  # name of the fingertip sensor; None if unknown
    scene: str = "unknown"  # where they were recorded, see `scene_of`
    length: int | None = None  # number of frames of the shortest; None if unknown
    cameras: tuple[str, ...] = ()  # keys of all cameras
    task: str = ""  # task in words, "" if unknown or if there are several

    @classmethod
    def of(cls, name: str, keys: Container[str], camera: str = ft.FRONT, **about: Any) -> "Inputs":
        """Return what is known of observations with these keys; `about` has the other fields."""
        sides = tuple(key for key in ft.TACTILE if key in keys)
        cameras = tuple(key for key in dict.fromkeys((*ft.CAMERAS, camera)) if key in keys)
        return cls(name, camera if camera in keys else None, sides, cameras=cameras, **about)

    @property
    def fitted_task(self) -> str:
        """Task that a value is fitted to: the simulated scene, else the task in words."""
        return self.scene if self.scene.startswith("simulated") else self.task

    @property
    def kind(self) -> tuple[object, ...]:
        """What recordings must share to be fitted together."""
        return self.fitted_task, self.camera, self.cameras, self.sides, self.sensor

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """Modalities that can be measured, given an aligned touch encoder."""
        image: tuple[Modality, ...] = () if self.camera is None else ("image",)
        return (*image, "tactile", "text", "force") if self.sides else image


@dataclass(frozen=True)
class OwnFrame:
    """Frame `index` (from 0) of the measured trajectory; None: its last one."""

    index: int | None = None
    modalities: ClassVar[tuple[Modality, ...]] = ("image", "tactile")

    def __str__(self) -> str:
        return "last" if self.index is None else f"frame:{self.index}"


@dataclass(frozen=True)
class GoalImage:
    """An image of the goal as the measured camera would take it: a file, or RGB from a script."""

    image: Path | UInt8[np.ndarray, "h w 3"]
    modalities: ClassVar[tuple[Modality, ...]] = ("image",)

    def __str__(self) -> str:
        return f"image:{self.image}" if isinstance(self.image, Path) else "image: an array"

    def read(self) -> UInt8[np.ndarray, "1 h w 3"]:
        """Return the image, RGB; UserError: no such file, not an image, or too small."""
        name, pixels = "the goal image", self.image
        if isinstance(pixels, Path):
            name, path = f"goal image {pixels}", pixels
            if (pixels := read_image(path)) is None:
                wrong = "cannot be read as an image" if path.exists() else "does not exist"
                raise UserError(f"{name} {wrong}")
        height, width, _ = pixels.shape
        if min(height, width) < _SMALLEST:
            raise UserError(
                f"{name} is {width} x {height} pixels: give one as the camera takes it, at least "
                f"{_SMALLEST} x {_SMALLEST}"
            )
        return pixels[None]


@dataclass(frozen=True, eq=False)
class TouchArrays:
    """Tactile images of the goal, from a script."""

    images: Mapping[str, UInt8[np.ndarray, "h w 3"]]  # by key of the fingertip, in the goal state
    # the same fingertips untouched; empty until the measured trajectory is known
    backgrounds: Mapping[str, UInt8[np.ndarray, "h w 3"]] = field(default_factory=dict)
    modalities: ClassVar[tuple[Modality, ...]] = ("tactile",)

    def __str__(self) -> str:
        return "touch: arrays"

    def beside(self, frames: Mapping[str, np.ndarray]) -> "TouchArrays":
        """Take the background from a trajectory's frames; UserError: it has other fingertips."""
        if self.images.keys() != {key for key in ft.TACTILE if key in frames}:
            raise UserError("the goal's fingertips must be the trajectory's: left, right or both")
        return replace(self, backgrounds={k: touch_background(frames[k]) for k in self.images})


@dataclass(frozen=True)
class EpisodeEnds:
    """The last frame of episode `index` of the episode set in `root`, or of each of its successes.

    Of several the nearest counts, softly; where objects are recorded, those with the object of the
    trajectory.
    """

    root: Path
    index: int | None = None  # None: every episode that is marked as a success
    keys: Mapping[str, str] = field(default_factory=dict, hash=False)  # as for `EpisodeSet`
    modalities: ClassVar[tuple[Modality, ...]] = ("image", "tactile")

    def __str__(self) -> str:
        return f"bank:{self.root}" if self.index is None else f"episode:{self.root}#{self.index}"

    def read(
        self, keys: Sequence[str] = (), also: Sequence[str] = ()
    ) -> Iterator[tuple[str, Episode]]:
        """Yield each one's name, and its first frames (for the background of touch) and, last, its last.

        The simulator's contact, the wrench and `also` are added where they are recorded. UserError: no
        such set, episode or key, or no episode marked as a success.
        """
        episodes = EpisodeSet(self.root, keys=self.keys)
        if self.index is None:
            chosen = [i for i in range(len(episodes)) if episodes.meta(i).get("success") is True]
        elif self.index < len(episodes):
            chosen = [self.index]
        else:
            raise UserError(
                f"goal '{self}' does not exist: {self.root} has episodes 0 to {len(episodes) - 1}"
            )
        if not chosen:
            raise UserError(f"goal '{self}': no episode of {self.root} is marked as a success")
        wanted = dict.fromkeys((*also, ft.TRUTH_CONTACT, ft.WRENCH, ft.TCP_POSE))
        more = [key for key in wanted if key in episodes.features and key not in keys]
        for i in chosen:
            length = episodes.lengths[i]
            frames = [*range(min(START_FRAMES, length)), length - 1]
            yield str(replace(self, index=i)), episodes.read(i, [*keys, *more], frames)


@dataclass(frozen=True)
class GoalFile:
    """Embedded ends of successes in a file, which fit-normalizer wrote: used as an `EpisodeEnds`."""

    path: Path
    modalities: ClassVar[tuple[Modality, ...]] = ("image", "tactile")

    def __str__(self) -> str:
        return f"goal:{self.path}"


@dataclass(frozen=True)
class Sentence:
    """Description of how the object feels; UserError if it is negated or contradicts itself."""

    text: str
    modalities: ClassVar[tuple[Modality, ...]] = ("text",)

    def __post_init__(self) -> None:
        check_goal_sentence(self.text)

    def __str__(self) -> str:
        return f"text:{self.text}"


@dataclass(frozen=True)
class GripForce:
    """Normal force on a fingertip, N, mean over the fingertips; UserError if it is not above 0."""

    newtons: float
    modalities: ClassVar[tuple[Modality, ...]] = ("force",)

    def __post_init__(self) -> None:
        if not 0 < self.newtons < math.inf:
            raise UserError(f"goal '{self}': a force is above 0 N, such as force:3.5")

    def __str__(self) -> str:
        return f"force:{self.newtons:g}"


def content_checksum(spec: "GoalSpec") -> str:
    """Return a text that changes when what a goal refers to does: its image, episodes or file."""
    if isinstance(spec, EpisodeEnds):
        of = EpisodeSet(spec.root, keys=spec.keys)
        return of.checksum if spec.index is None else of.episode_checksum(spec.index)
    if isinstance(spec, GoalFile):
        return hashlib.sha256(spec.path.read_bytes()).hexdigest()
    if isinstance(spec, GoalImage):
        return hashlib.sha256(spec.read().tobytes()).hexdigest()
    return str(spec)


GoalSpec = OwnFrame | GoalImage | TouchArrays | EpisodeEnds | GoalFile | Sentence | GripForce
Goals = Mapping[Modality, GoalSpec]
"""The goal of each modality that has one."""
GoalLike = GoalSpec | str | int | np.ndarray | Mapping[str, np.ndarray]
"""A goal in a script; see `touchgoal.Reward`."""

SIDES = {"left": ft.TACTILE_LEFT, "right": ft.TACTILE_RIGHT}
"""Names of the fingertips in a script, and their keys."""


def same_episode(goals: Goals) -> frozenset[str]:
    """Return the modalities whose goal is a frame of the measured trajectory itself."""
    return frozenset(m for m, spec in goals.items() if isinstance(spec, OwnFrame))


def parse_goal(text: str, keys: Mapping[str, str] | None = None) -> GoalSpec:
    """Read a goal in one of `FORMS`; `keys`, for episode sets, as for `EpisodeSet`.

    UserError, with the forms: any other text.
    """
    kind, _, value = (part.strip() for part in text.partition(":"))
    if text.strip() == "last":
        return OwnFrame()
    if kind == "frame" and re.fullmatch(r"\d+", value):
        return OwnFrame(int(value))
    if kind == "image" and value:
        return GoalImage(Path(value))
    if kind == "episode" and (episode := re.fullmatch(r"(.+)#(\d+)", value)):
        return EpisodeEnds(Path(episode[1]), int(episode[2]), keys or {})
    if kind == "bank" and value:
        return EpisodeEnds(Path(value), keys=keys or {})
    if kind == "goal" and value:
        return GoalFile(Path(value))
    if kind == "text" and value:
        return Sentence(value)
    if kind == "force" and re.fullmatch(r"-?\d*\.?\d+", value):
        return GripForce(float(value))
    raise UserError(f"goal '{text}' is not understood; write {FORMS}")


def goals_of_script(goal: GoalLike | Sequence[GoalLike]) -> list[GoalSpec]:
    """Return a script's goals, arrays or text; UserError: one is no goal."""
    if isinstance(goal, GoalSpec):
        return [goal]
    if isinstance(goal, np.ndarray):
        check_images("the goal", goal, ndim=(3,))
        return [GoalImage(goal)]
    if isinstance(goal, int):
        if goal < 0:
            raise UserError(f"goal {goal} is not a frame: count from 0, or give 'last'")
        return [OwnFrame(goal)]
    if isinstance(goal, str):
        known = goal.strip() == "last" or re.match(
            r"\s*(frame|image|episode|bank|goal|text|force):", goal
        )
        return [parse_goal(goal) if known else Sentence(goal)]
    if not isinstance(goal, Mapping):
        return [spec for one in goal for spec in goals_of_script(one)]
    for name, image in goal.items():
        if name != "image" and name not in SIDES:
            raise UserError(f"a goal has no '{name}': give image, left, right or several of them")
        check_images(f"the goal's {name}", image, ndim=(3,))
    touch = {SIDES[name]: image for name, image in goal.items() if name in SIDES}
    images: list[GoalSpec] = [GoalImage(goal["image"])] if "image" in goal else []
    return [*images, *([TouchArrays(touch)] if touch else [])]


def assign_goals(
    specs: Sequence[GoalSpec], available: Sequence[Modality], image_words: bool = False
) -> Goals:
    """Give each available modality the first goal that applies to it.

    With `image_words`, of towers that compare images with sentences, a sentence is a goal for
    images where there is no touch. UserError: no goal, or one that no modality takes.
    """
    if not specs:
        raise UserError(f"no goal was given; write {FORMS}")
    taken: dict[Modality, GoalSpec] = {}
    for spec in specs:
        wanted: list[Modality] = [m for m in spec.modalities if m in available]
        if isinstance(spec, Sentence) and not wanted:
            if not image_words:
                raise UserError(
                    f"goal '{spec}' is a sentence, and there is no touch to compare it with; the "
                    "offline image tower knows no words: give --towers with a CLIP (Hugging Face id "
                    "or folder) to compare it with the images, or a goal of images: last, frame:K, "
                    "image:PATH or episode:ROOT#K"
                )
            wanted = ["image"]
        if not wanted:
            raise UserError(
                f"goal '{spec}' applies to {' and '.join(spec.modalities)}, but this source has "
                f"{' and '.join(available)} only; leave the goal out"
            )
        if taken.keys() >= set(wanted):
            raise UserError(
                f"goal '{spec}' is never used: '{taken[wanted[0]]}' before it already applies to "
                f"{' and '.join(wanted)}; put it first or leave it out"
            )
        taken = dict.fromkeys(wanted, spec) | taken
    return {name: taken[name] for name in MODALITIES if name in taken}


def check_goals(goals: Goals, inputs: Inputs) -> None:
    """Check before any work that goals can be read.

    UserError: a frame beyond the trajectory; no such image, set, episode, camera or fingertip.
    """
    for modality, spec in goals.items():
        if isinstance(spec, OwnFrame) and inputs.length is not None:
            frame_index(spec, inputs.length, inputs.name)
        if isinstance(spec, GoalImage):
            spec.read()
        if isinstance(spec, EpisodeEnds):
            next(spec.read([inputs.camera or ft.FRONT] if modality == "image" else inputs.sides))
        if isinstance(spec, GoalFile) and not spec.path.is_file():
            raise UserError(f"goal '{spec}' does not exist: write one with fit-normalizer")


def frame_index(spec: OwnFrame, length: int, source: str) -> int:
    """Return the frame of the trajectory that is its goal; UserError if it has no such frame."""
    if spec.index is None:
        return length - 1
    if spec.index >= length:
        raise UserError(f"goal '{spec}' lies beyond {source}, whose frames are 0 to {length - 1}")
    return spec.index


def missing_camera(source: str, camera: str, cameras: Sequence[str]) -> str:
    """Return the message for a source that lacks a camera."""
    there = f"choose --camera {' or '.join(cameras)}" if cameras else "it has no camera"
    return f"{source} has no images of {camera}: {there}"
