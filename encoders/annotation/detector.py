"""Open-vocabulary detection by Grounding DINO (Liu et al., ECCV 2024), in the place of the paper's GLIP."""

from typing import Any

import torch

from touchgoal.encoders.annotation.boxes import Detection, Image, area, clipped
from touchgoal.encoders.towers.transformers_models import load_model, load_part

_LOWEST_SCORE = 0.05  # boxes below are background; the others are counted as low confidence


class GroundingDino:
    """A Grounding DINO of transformers, with image processing by PIL, without torchvision."""

    def __init__(self, source: str, device: str = "cpu") -> None:
        """Load it by Hugging Face id or folder; UserError if there is none."""
        self._model = load_model(
            source, "GroundingDinoForObjectDetection", "grounding-dino", device
        )
        from transformers import AutoTokenizer, GroundingDinoProcessor
        from transformers.models.grounding_dino.image_processing_pil_grounding_dino import (
            GroundingDinoImageProcessorPil,
        )

        self._processor: Any = GroundingDinoProcessor(
            load_part(source, GroundingDinoImageProcessorPil), load_part(source, AutoTokenizer)
        )
        self._device = device

    @torch.no_grad()
    def detect(self, image: Image, prompt: str) -> list[Detection]:
        """Return the boxes of what a prompt names, with scores from 0.05."""
        text = (
            f"{prompt.strip().lower().rstrip('.')}."  # as it was trained: lower case, a full stop
        )
        inputs = self._processor(images=image, text=text, return_tensors="pt").to(self._device)
        found = self._processor.post_process_grounded_object_detection(
            self._model(**inputs),
            inputs["input_ids"],
            threshold=_LOWEST_SCORE,
            text_threshold=_LOWEST_SCORE,
            target_sizes=[image.shape[:2]],
        )[0]
        detections = []
        for corners, score in zip(found["boxes"].tolist(), found["scores"].tolist(), strict=True):
            left, top, right, bottom = corners
            box = clipped((left, top, right, bottom), image)
            if area(box):
                detections.append(Detection(box, score))
        return detections
