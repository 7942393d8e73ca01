"""Interface of the networks and the tracker that annotate a recording."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from touchgoal.encoders.annotation.boxes import Box, Image


@dataclass(frozen=True)
class Detection:
    """A box in an image.

    Attributes:
        box: In px.
        score: Confidence of the detector, in [0, 1].
    """

    box: Box
    score: float


@runtime_checkable  # beartype checks arguments in tests
class AnnotationModels(Protocol):
    """A detector, a tracker and a captioner.

    Attributes:
        names: What they are, for the provenance of annotations.
    """

    names: dict[str, str]

    def detect(self, image: Image, prompt: str) -> list[Detection]:
        """Return the boxes of what a prompt names, also those with a low score."""
        ...

    def track(self, frames: Iterable[Image], box: Box) -> list[Box | None]:
        """Follow what a box shows in the first frame; None for a frame in which it is lost."""
        ...

    def caption(self, image: Image, prompt: str) -> str:
        """Return the answer to a prompt on an image, one line."""
        ...
