"""The real models of the annotation: Grounding DINO, CSRT, BLIP-2."""

from collections.abc import Iterable

from touchgoal.encoders.annotation.boxes import Box, Image
from touchgoal.encoders.annotation.captioner import Blip2
from touchgoal.encoders.annotation.detector import GroundingDino
from touchgoal.encoders.annotation.models import Detection
from touchgoal.encoders.annotation.sensor_tracking import TRACKER, track_csrt


class PretrainedModels:
    """`AnnotationModels` of pretrained networks."""

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
