"""Goals of a trajectory, and the modality that each one applies to; docs/rewards.md has the forms.

Three modalities: "image" (camera image to goal image), "tactile" (touch to goal touch) and "text"
(touch to goal sentence). Each takes the first goal that applies; one that none takes is an error.
Without touch, and with towers that were trained together (a CLIP), a sentence is a goal for images.
"""

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import UInt8

from touchgoal.control.features import FRONT, TRUTH_CONTACT, WRENCH
from touchgoal.encoders.towers.goal_sentence import check_goal_sentence
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet
from touchgoal.rewards.metrics import START_FRAMES
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.picture_file import read_picture

Modality = Literal["image", "tactile", "text"]
MODALITIES: tuple[Modality, ...] = ("image", "tactile", "text")

FORMS = "last, frame:K, image:PATH, episode:ROOT#K, bank:SET, goal:FILE or text:SENTENCE"
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

    @property
    def fitted_task(self) -> str:
        """Task that a value is fitted to: the simulated scene, else the task in words."""
        return self.scene if self.scene.startswith("simulated") else self.task

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """Modalities that can be measured, given an aligned touch encoder."""
        image: tuple[Modality, ...] = () if self.camera is None else ("image",)
        return (*image, "tactile", "text") if self.sides else image


@dataclass(frozen=True)
class OwnFrame:
    """Frame `index` (from 0) of the measured trajectory; None: its last one."""

    index: int | None = None
    modalities: ClassVar[tuple[Modality, ...]] = ("image", "tactile")

    def __str__(self) -> str:
        return "last" if self.index is None else f"frame:{self.index}"


@dataclass(frozen=True)
class GoalPicture:
    """An image of the goal as the measured camera would take it: a file, or RGB from a script."""

    picture: Path | UInt8[np.ndarray, "h w 3"]
    modalities: ClassVar[tuple[Modality, ...]] = ("image",)

    def __str__(self) -> str:
        return f"image:{self.picture}" if isinstance(self.picture, Path) else "image: an array"

    def read(self) -> UInt8[np.ndarray, "1 h w 3"]:
        """Return the image, RGB; UserError: no such file, not an image, or too small."""
        name, pixels = "the goal image", self.picture
        if isinstance(pixels, Path):
            name, path = f"goal image {pixels}", pixels
            if (pixels := read_picture(path)) is None:
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

    pictures: Mapping[str, UInt8[np.ndarray, "h w 3"]]  # by key of the fingertip, in the goal state
    backgrounds: Mapping[str, UInt8[np.ndarray, "h w 3"]]  # the same fingertips untouched
    modalities: ClassVar[tuple[Modality, ...]] = ("tactile",)

    def __str__(self) -> str:
        return "touch: arrays"


@dataclass(frozen=True)
class EpisodeEnd:
    """The last frame of episode `index` of the episode set in `root`."""

    root: Path
    index: int
    keys: Mapping[str, str] = field(default_factory=dict, hash=False)  # as for `EpisodeSet`
    modalities: ClassVar[tuple[Modality, ...]] = ("image", "tactile")

    def __str__(self) -> str:
        return f"episode:{self.root}#{self.index}"

    def read(self, keys: Sequence[str]) -> Episode:
        """Return the first frames (for the background of touch) and, last, the last frame.

        The simulator's contact and the wrench are added where they are recorded. UserError: no such set, episode or
        key.
        """
        episodes = EpisodeSet(self.root, keys=self.keys)
        if self.index >= len(episodes):
            raise UserError(
                f"goal '{self}' does not exist: {self.root} has episodes 0 to {len(episodes) - 1}"
            )
        length = episodes.lengths[self.index]
        more = [key for key in (TRUTH_CONTACT, WRENCH) if key in episodes.features]
        frames = [*range(min(START_FRAMES, length)), length - 1]
        return episodes.read(self.index, [*keys, *more], frames)


@dataclass(frozen=True)
class Bank:
    """The ends of all successful episodes of the set in `root`; the nearest counts, softly.

    Where objects are recorded, those with the object of the trajectory.
    """

    root: Path
    keys: Mapping[str, str] = field(default_factory=dict, hash=False)  # as for `EpisodeSet`
    modalities: ClassVar[tuple[Modality, ...]] = ("image", "tactile")

    def __str__(self) -> str:
        return f"bank:{self.root}"

    def ends(self) -> list[EpisodeEnd]:
        """Return the ends; UserError: no such set, or no episode marked as a success."""
        episodes = EpisodeSet(self.root, keys=self.keys)
        found = [i for i in range(len(episodes)) if episodes.meta(i).get("success") is True]
        if not found:
            raise UserError(f"goal '{self}': no episode of {self.root} is marked as a success")
        return [EpisodeEnd(self.root, i, self.keys) for i in found]


@dataclass(frozen=True)
class GoalFile:
    """Embedded ends of successes in a file, which fit-normalizer wrote: used as a `Bank`."""

    path: Path
    modalities: ClassVar[tuple[Modality, ...]] = ("image", "tactile")

    def __str__(self) -> str:
        return f"goal:{self.path}"


@dataclass(frozen=True)
class Sentence:
    """Description of how the object feels; UserError if it is negated or contradicts itself.

    With a baseline sentence, such as "an object", only the direction from it to the sentence counts
    (VLM-RM, arXiv 2310.12921): see `distance.embedding_distance.text_distances`.
    """

    text: str
    baseline: str = ""
    modalities: ClassVar[tuple[Modality, ...]] = ("text",)

    def __post_init__(self) -> None:
        """Check both sentences."""
        check_goal_sentence(self.text)
        check_goal_sentence(self.baseline)

    def __str__(self) -> str:
        return f"text:{self.text}" + (f"|{self.baseline}" if self.baseline else "")


def content_checksum(spec: "GoalSpec") -> str:
    """Return a text that changes when what a goal refers to does: its picture, episodes or file."""
    if isinstance(spec, EpisodeEnd):
        return EpisodeSet(spec.root, keys=spec.keys).episode_checksum(spec.index)
    if isinstance(spec, Bank):
        return EpisodeSet(spec.root, keys=spec.keys).checksum
    if isinstance(spec, GoalFile):
        return hashlib.sha256(spec.path.read_bytes()).hexdigest()
    if isinstance(spec, GoalPicture):
        return hashlib.sha256(spec.read().tobytes()).hexdigest()
    return str(spec)


PictureGoal = OwnFrame | GoalPicture | EpisodeEnd | Bank | GoalFile | Sentence
TouchGoal = OwnFrame | TouchArrays | EpisodeEnd | Bank | GoalFile
GoalSpec = PictureGoal | TouchGoal


@dataclass(frozen=True)
class Goal:
    """The goal of each modality; None without one."""

    image: PictureGoal | None = None
    tactile: TouchGoal | None = None
    text: Sentence | None = None

    @property
    def same_episode(self) -> frozenset[str]:
        """Modalities whose goal is a frame of the measured trajectory itself."""
        return frozenset(m for m in MODALITIES if isinstance(getattr(self, m), OwnFrame))

    @property
    def specs(self) -> list[GoalSpec]:
        """Goals of all modalities that have one."""
        given = (getattr(self, name) for name in MODALITIES)
        return [spec for spec in given if spec is not None]

    def as_dict(self) -> dict[str, str]:
        """Return the goal of each modality that has one, in the form that a user writes."""
        specs = {name: getattr(self, name) for name in MODALITIES}
        return {name: str(spec) for name, spec in specs.items() if spec is not None}


def parse_goal(text: str, keys: Mapping[str, str] | None = None) -> GoalSpec:
    """Read a goal in one of `FORMS`; `keys`, for episode sets, as for `EpisodeSet`.

    UserError, with the forms: any other text.
    """
    kind, _, value = text.strip().partition(":")
    value = value.strip()
    episode = re.fullmatch(r"(.+)#(\d+)", value)
    if text.strip() == "last":
        return OwnFrame()
    if kind == "frame" and re.fullmatch(r"\d+", value):
        return OwnFrame(int(value))
    if kind == "image" and value:
        return GoalPicture(Path(value))
    if kind == "episode" and episode:
        return EpisodeEnd(Path(episode[1]), int(episode[2]), keys or {})
    if kind == "bank" and value:
        return Bank(Path(value), keys or {})
    if kind == "goal" and value:
        return GoalFile(Path(value))
    if kind == "text" and value.partition("|")[0].strip():
        sentence, _, baseline = value.partition("|")
        return Sentence(sentence.strip(), baseline.strip())
    raise UserError(f"goal '{text}' is not understood; write {FORMS}")


def assign_goals(
    specs: Sequence[GoalSpec], available: Sequence[Modality], picture_words: bool = False
) -> Goal:
    """Give each available modality the first goal that applies to it.

    With `picture_words`, of towers that compare images with sentences, a sentence is a goal for
    images where there is no touch. UserError: no goal, or one that no modality takes.
    """
    if not specs:
        raise UserError(f"no goal was given; write {FORMS}")
    taken: dict[str, GoalSpec] = {}
    for spec in specs:
        wanted = [m for m in spec.modalities if m in available]
        if isinstance(spec, Sentence) and not wanted:
            if not picture_words:
                raise UserError(_no_words(spec))
            wanted = ["image"]
        if not wanted:
            raise UserError(
                f"goal '{spec}' applies to {' and '.join(spec.modalities)}, but this source has "
                f"{' and '.join(available)} only; leave the goal out"
            )
        free = [m for m in wanted if m not in taken]
        if not free:
            raise UserError(
                f"goal '{spec}' is never used: '{taken[wanted[0]]}' before it already applies to "
                f"{' and '.join(wanted)}; put it first or leave it out"
            )
        taken |= dict.fromkeys(free, spec)
    return Goal(**taken)  # pyright: ignore[reportArgumentType]  modalities fixes the types


def check_goal(goal: Goal, inputs: Inputs) -> None:
    """Check before any work that a goal can be read.

    UserError: a frame beyond the trajectory; no such image, set, episode, camera or fingertip.
    """
    for spec in (goal.image, goal.tactile):
        if isinstance(spec, OwnFrame) and inputs.length is not None:
            frame_index(spec, inputs.length, inputs.name)
    if isinstance(goal.image, GoalPicture):
        goal.image.read()
    if isinstance(goal.image, EpisodeEnd):
        goal.image.read([inputs.camera or FRONT])
    if isinstance(goal.tactile, EpisodeEnd):
        goal.tactile.read(inputs.sides)
    for spec in (goal.image, goal.tactile):
        if isinstance(spec, Bank):
            spec.ends()
        if isinstance(spec, GoalFile) and not spec.path.is_file():
            raise UserError(f"goal '{spec}' does not exist: write one with fit-normalizer")


def frame_index(spec: OwnFrame, length: int, source: str) -> int:
    """Return the frame of the trajectory that is its goal; UserError if it has no such frame."""
    if spec.index is None:
        return length - 1
    if spec.index >= length:
        raise UserError(f"goal '{spec}' lies beyond {source}, whose frames are 0 to {length - 1}")
    return spec.index


def _no_words(spec: Sentence) -> str:
    return (
        f"goal '{spec}' is a sentence, and there is no touch to compare it with; the offline image "
        "tower knows no words: give --towers with a CLIP (Hugging Face id or folder) to compare it "
        "with the images, or a goal of images: last, frame:K, image:PATH or episode:ROOT#K"
    )
