"""The networks that annotate a recording: their interface, and the pretrained ones."""

from typing import Protocol, runtime_checkable

from touchgoal.encoders.annotation.boxes import Detection, Image
from touchgoal.encoders.annotation.captioner import Blip2
from touchgoal.encoders.annotation.detector import GroundingDino
from touchgoal.encoders.annotation.sensor_tracking import TRACKER


@runtime_checkable  # beartype checks arguments in tests
class AnnotationModels(Protocol):
    """A detector and a captioner; `names` says which, for the provenance of annotations."""

    names: dict[str, str]

    def detect(self, image: Image, prompt: str) -> list[Detection]:
        """Return the boxes of what a prompt names, also those with a low score."""
        ...

    def caption(self, image: Image, prompt: str) -> str:
        """Return the answer to a prompt on an image, one line."""
        ...


class PretrainedModels:
    """Grounding DINO and BLIP-2."""

    def __init__(self, detector: str, captioner: str, device: str = "cpu") -> None:
        """Load both, each by Hugging Face id or folder; UserError if there is none."""
        self.names = {"detector": detector, "captioner": captioner, "tracker": TRACKER}
        self.detect = GroundingDino(detector, device).detect
        self.caption = Blip2(captioner, device).caption
