"""The networks and the tracker that annotate a recording: their interface, and the pretrained ones."""

from collections.abc import Iterable
from typing import Protocol, runtime_checkable

from touchgoal.encoders.annotation.boxes import Box, Detection, Image
from touchgoal.encoders.annotation.captioner import Blip2
from touchgoal.encoders.annotation.detector import GroundingDino
from touchgoal.encoders.annotation.sensor_tracking import TRACKER, track_csrt


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


class PretrainedModels:
    """Grounding DINO, CSRT and BLIP-2."""

    def __init__(self, detector: str, captioner: str, device: str = "cpu") -> None:
        """Load both networks, each by Hugging Face id or folder; UserError if there is none."""
        self.names = {"detector": detector, "captioner": captioner, "tracker": TRACKER}
        self._detector, self._captioner = GroundingDino(detector, device), Blip2(captioner, device)

    def detect(self, image: Image, prompt: str) -> list[Detection]:
        """Detect by Grounding DINO."""
        return self._detector.detect(image, prompt)

    def track(self, frames: Iterable[Image], box: Box) -> list[Box | None]:
        """Track by CSRT."""
        return track_csrt(frames, box)

    def caption(self, image: Image, prompt: str) -> str:
        """Caption by BLIP-2."""
        return self._captioner.caption(image, prompt)
