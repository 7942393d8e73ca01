"""Captions by BLIP-2 (Li et al., ICML 2023)."""

from typing import Any

import torch

from touchgoal.encoders.annotation.boxes import Image
from touchgoal.encoders.towers.transformers_models import load_model, load_part

_MOST_TOKENS = 30


class Blip2:
    """A BLIP-2 of transformers, with image processing by PIL, without torchvision."""

    def __init__(self, source: str, device: str = "cpu") -> None:
        """Load it by Hugging Face id or folder; UserError if there is none."""
        self._model = load_model(source, "Blip2ForConditionalGeneration", "blip-2", device)
        from transformers import AutoTokenizer, Blip2Processor
        from transformers.models.blip.image_processing_pil_blip import BlipImageProcessorPil

        self._processor: Any = Blip2Processor(
            load_part(source, BlipImageProcessorPil),
            load_part(source, AutoTokenizer),
            num_query_tokens=self._model.config.num_query_tokens,
        )
        self._device = device

    @torch.no_grad()
    def caption(self, image: Image, prompt: str) -> str:
        """Return the most likely answer to a prompt on an image, at most 30 tokens in one line."""
        inputs = self._processor(images=image, text=prompt, return_tensors="pt").to(self._device)
        tokens = self._model.generate(**inputs, max_new_tokens=_MOST_TOKENS, do_sample=False)[0]
        if not self._model.language_model.config.is_encoder_decoder:  # OPT repeats the prompt
            tokens = tokens[inputs["input_ids"].shape[1] :]
        answer = self._processor.tokenizer.decode(tokens, skip_special_tokens=True)
        return " ".join(answer.split())
