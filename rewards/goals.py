"""Goals: what a trajectory should end near, and which modality each goal speaks for.

A goal is written in one of five forms:

    last                the last frame of the episode itself (MMWand, Figure 8)
    frame:K             frame K of the episode itself, counted from 0
    image:PATH          a picture
    episode:ROOT#K      the last frame of episode K of the episode set in ROOT
    text:SENTENCE       how the object feels, in words (MMWand, Figure 9)

There are three modalities, each a distance of its own: "image" (camera against goal picture),
"tactile" (touch against goal touch), "text" (touch against goal sentence). A frame or an episode
speaks for image and tactile, a picture for image, a sentence for text. Several goals may be given:
each modality takes the first goal that speaks for it, and a goal left without a modality is an
error, so `last` and `text:a hard smooth ball` together give all curves of Figures 8 and 9. A
sentence is a goal for touch: the camera sees the object from the first frame on, so the distance of
the picture to how it feels says nothing about how far the task has come. Where there is no touch
and the towers were trained together (a CLIP), a sentence is a goal for pictures, and says what is
to be seen; the offline image tower knows no words.

The own last frame flatters: every episode, a failed one too, ends at distance 0 of it. To judge
episodes, give the end of another, successful one.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from touchgoal.control.features import TRUTH_CONTACT
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet
from touchgoal.rewards.metrics import START_FRAMES
from touchgoal.runtime.errors import UserError

Modality = Literal["image", "tactile", "text"]
MODALITIES: tuple[Modality, ...] = ("image", "tactile", "text")

FORMS = "last, frame:K, image:PATH, episode:ROOT#K or text:SENTENCE"


@dataclass(frozen=True)
class LastFrame:
    """The last frame of the measured episode itself."""

    modalities: ClassVar[tuple[Modality, ...]] = ("image", "tactile")

    def __str__(self) -> str:
        """The form a user writes."""
        return "last"


@dataclass(frozen=True)
class FrameNumber:
    """Frame `index` (from 0) of the measured episode itself."""

    index: int
    modalities: ClassVar[tuple[Modality, ...]] = ("image", "tactile")

    def __str__(self) -> str:
        """The form a user writes."""
        return f"frame:{self.index}"


@dataclass(frozen=True)
class PictureFile:
    """A picture file of the goal, as the measured camera would see it."""

    path: Path
    modalities: ClassVar[tuple[Modality, ...]] = ("image",)

    def __str__(self) -> str:
        """The form a user writes."""
        return f"image:{self.path}"

    def read(self) -> UInt8[np.ndarray, "1 h w 3"]:
        """The picture, RGB.

        Raises:
            UserError: there is no such file, or it is no picture.
        """
        try:
            with Image.open(self.path) as picture:
                return np.asarray(picture.convert("RGB"))[None]
        except FileNotFoundError:
            raise UserError(f"goal picture {self.path} does not exist") from None
        except (
            UnidentifiedImageError,
            OSError,
            ValueError,
            SyntaxError,
            Image.DecompressionBombError,
        ):
            raise UserError(f"goal picture {self.path} cannot be read as an image") from None


@dataclass(frozen=True, eq=False)
class PictureArray:
    """A picture of the goal, as the measured camera would see it, from a script."""

    picture: UInt8[np.ndarray, "h w 3"]
    modalities: ClassVar[tuple[Modality, ...]] = ("image",)

    def __str__(self) -> str:
        """For people; it has no form that a user writes."""
        return "image: an array"

    def read(self) -> UInt8[np.ndarray, "1 h w 3"]:
        """The picture, RGB."""
        return self.picture[None]


@dataclass(frozen=True, eq=False)
class TouchArrays:
    """Fingertip pictures of the goal, from a script.

    Attributes:
        pictures: by vocabulary key of the fingertip, in the goal state.
        backgrounds: the same fingertips untouched.
    """

    pictures: Mapping[str, UInt8[np.ndarray, "h w 3"]]
    backgrounds: Mapping[str, UInt8[np.ndarray, "h w 3"]]
    modalities: ClassVar[tuple[Modality, ...]] = ("tactile",)

    def __str__(self) -> str:
        """For people; it has no form that a user writes."""
        return "touch: arrays"


@dataclass(frozen=True)
class EpisodeEnd:
    """The last frame of episode `index` of the episode set in `root`."""

    root: Path
    index: int
    modalities: ClassVar[tuple[Modality, ...]] = ("image", "tactile")

    def __str__(self) -> str:
        """The form a user writes."""
        return f"episode:{self.root}#{self.index}"

    def read(self, keys: Sequence[str]) -> Episode:
        """The first frames (for the background of touch) and, last, the last frame.

        Args:
            keys: the keys to read; the simulator's contact truth comes along where it is recorded.

        Raises:
            UserError: no such set, episode or key.
        """
        episodes = EpisodeSet(self.root)
        if self.index >= len(episodes):
            raise UserError(
                f"goal '{self}' does not exist: {self.root} has episodes 0 to {len(episodes) - 1}"
            )
        length = episodes.lengths[self.index]
        truth = [TRUTH_CONTACT] if TRUTH_CONTACT in episodes.features else []
        frames = [*range(min(START_FRAMES, length)), length - 1]
        return episodes.read(self.index, [*keys, *truth], frames)


@dataclass(frozen=True)
class Sentence:
    """How the object feels, in words. Sentence encoders hardly see a "not": say what is there."""

    text: str
    modalities: ClassVar[tuple[Modality, ...]] = ("text",)

    def __str__(self) -> str:
        """The form a user writes."""
        return f"text:{self.text}"


GoalSpec = (
    LastFrame | FrameNumber | PictureFile | PictureArray | TouchArrays | EpisodeEnd | Sentence
)


@dataclass(frozen=True)
class Goal:
    """What to be near, per modality; None where no goal speaks for a modality."""

    image: LastFrame | FrameNumber | PictureFile | PictureArray | EpisodeEnd | Sentence | None = (
        None
    )
    tactile: LastFrame | FrameNumber | TouchArrays | EpisodeEnd | None = None
    text: Sentence | None = None

    @property
    def own(self) -> frozenset[str]:
        """Modalities whose goal is a frame of the measured episode itself."""
        return frozenset(
            m for m in MODALITIES if isinstance(getattr(self, m), LastFrame | FrameNumber)
        )

    def as_dict(self) -> dict[str, str]:
        """The goal of each modality that has one, in the form a user writes."""
        specs = {name: getattr(self, name) for name in MODALITIES}
        return {name: str(spec) for name, spec in specs.items() if spec is not None}


def parse_goal(text: str) -> GoalSpec:
    """Read one goal in one of the five forms of this module.

    Raises:
        UserError: any other text; the message lists the forms.
    """
    kind, _, value = text.strip().partition(":")
    value = value.strip()
    episode = re.fullmatch(r"(.+)#(\d+)", value)
    if text.strip() == "last":
        return LastFrame()
    if kind == "frame" and re.fullmatch(r"\d+", value):
        return FrameNumber(int(value))
    if kind == "image" and value:
        return PictureFile(Path(value))
    if kind == "episode" and episode:
        return EpisodeEnd(Path(episode[1]), int(episode[2]))
    if kind == "text" and value:
        return Sentence(value)
    raise UserError(f"goal '{text}' is not understood; write {FORMS}")


def assign_goals(
    specs: Sequence[GoalSpec], available: Sequence[Modality], picture_words: bool = False
) -> Goal:
    """Give each available modality the first goal that speaks for it.

    Args:
        specs: goals in the order given.
        available: modalities of the measured source; a plain video has "image" alone.
        picture_words: whether the towers can compare pictures with sentences; then a sentence is a
            goal for pictures where there is no touch.

    Raises:
        UserError: no goal, or one that no modality takes.
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
                f"goal '{spec}' speaks for {' and '.join(spec.modalities)}, but this source has "
                f"{' and '.join(available)} only; leave the goal out"
            )
        free = [m for m in wanted if m not in taken]
        if not free:
            raise UserError(
                f"goal '{spec}' is never used: '{taken[wanted[0]]}' before it already speaks for "
                f"{' and '.join(wanted)}; put it first or leave it out"
            )
        taken |= dict.fromkeys(free, spec)
    return Goal(**taken)  # pyright: ignore[reportArgumentType]  modalities fixes the types


def check_goal(goal: Goal, length: int, source: str, camera: str, sides: Sequence[str]) -> None:
    """Find out before any work whether a goal can be read.

    Args:
        goal: of one trajectory.
        length: its number of frames.
        source: its name, for people.
        camera: vocabulary key of its camera.
        sides: vocabulary keys of its fingertips.

    Raises:
        UserError: a frame beyond the trajectory; no such picture, set, episode, camera or fingertip.
    """
    for spec in (goal.image, goal.tactile):
        if isinstance(spec, LastFrame | FrameNumber):
            frame_index(spec, length, source)
    if isinstance(goal.image, PictureFile):
        goal.image.read()
    if isinstance(goal.image, EpisodeEnd):
        goal.image.read([camera])
    if isinstance(goal.tactile, EpisodeEnd):
        goal.tactile.read(sides)


def frame_index(spec: LastFrame | FrameNumber, length: int, source: str) -> int:
    """The frame that a goal in the episode itself means; UserError if there is none."""
    if isinstance(spec, LastFrame):
        return length - 1
    if spec.index >= length:
        raise UserError(f"goal '{spec}' lies beyond {source}, whose frames are 0 to {length - 1}")
    return spec.index


def _no_words(spec: Sentence) -> str:
    return (
        f"goal '{spec}' is a sentence, and there is no touch to compare it with; the offline image "
        "tower knows no words: give --towers with a CLIP (Hugging Face id or folder) to compare it "
        "with the pictures, or a goal of pictures: last, frame:K, image:PATH or episode:ROOT#K"
    )
