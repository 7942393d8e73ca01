"""The networks that annotate a recording: their interface, and the pretrained ones of transformers."""

from typing import Any, Protocol, runtime_checkable

import torch

from touchgoal.control.arrays import Image
from touchgoal.encoders.annotation.boxes import TRACKER, Detection, area, clipped
from touchgoal.encoders.towers.transformers_models import load_model, load_part

_LOWEST_SCORE = 0.05  # boxes below are background; the others are counted as low confidence
_MOST_TOKENS = 30


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
    """Grounding DINO (Liu et al., ECCV 2024), in the place of the paper's GLIP, and BLIP-2 (Li et al., ICML 2023).

    Image processing is by PIL, without torchvision.
    """

    def __init__(self, detector: str, captioner: str, device: str = "cpu") -> None:
        """Load both, each by Hugging Face id or folder; UserError if there is none."""
        self.names = {"detector": detector, "captioner": captioner, "tracker": TRACKER}
        self._device = device
        self._dino = load_model(
            detector, "GroundingDinoForObjectDetection", "grounding-dino", device
        )
        self._blip = load_model(captioner, "Blip2ForConditionalGeneration", "blip-2", device)
        from transformers import AutoTokenizer, Blip2Processor, GroundingDinoProcessor
        from transformers.models.blip.image_processing_pil_blip import BlipImageProcessorPil
        from transformers.models.grounding_dino.image_processing_pil_grounding_dino import (
            GroundingDinoImageProcessorPil,
        )

        self._dino_processor: Any = GroundingDinoProcessor(
            load_part(detector, GroundingDinoImageProcessorPil), load_part(detector, AutoTokenizer)
        )
        self._blip_processor: Any = Blip2Processor(
            load_part(captioner, BlipImageProcessorPil),
            load_part(captioner, AutoTokenizer),
            num_query_tokens=self._blip.config.num_query_tokens,
        )

    @torch.no_grad()
    def detect(self, image: Image, prompt: str) -> list[Detection]:
        """Return the boxes of what a prompt names, with scores from 0.05."""
        # as it was trained: lower case, a full stop
        text = f"{prompt.strip().lower().rstrip('.')}."
        inputs = self._dino_processor(images=image, text=text, return_tensors="pt")
        found = self._dino_processor.post_process_grounded_object_detection(
            self._dino(**inputs.to(self._device)),
            inputs["input_ids"],
            threshold=_LOWEST_SCORE,
            text_threshold=_LOWEST_SCORE,
            target_sizes=[image.shape[:2]],
        )[0]
        boxes = [clipped(tuple(corners), image) for corners in found["boxes"].tolist()]
        scores = found["scores"].tolist()
        return [Detection(b, s) for b, s in zip(boxes, scores, strict=True) if area(b)]

    @torch.no_grad()
    def caption(self, image: Image, prompt: str) -> str:
        """Return the most likely answer to a prompt on an image, at most 30 tokens in one line."""
        inputs = self._blip_processor(images=image, text=prompt, return_tensors="pt")
        inputs = inputs.to(self._device)
        tokens = self._blip.generate(**inputs, max_new_tokens=_MOST_TOKENS, do_sample=False)[0]
        if not self._blip.language_model.config.is_encoder_decoder:  # OPT repeats the prompt
            tokens = tokens[inputs["input_ids"].shape[1] :]
        answer = self._blip_processor.tokenizer.decode(tokens, skip_special_tokens=True)
        return " ".join(answer.split())
