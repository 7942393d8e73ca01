"""Embedders of real tactile images: our encoders, published ones, and baselines."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Int, UInt8

from touchgoal.encoders.alignment.touch_encoder import TouchEncoder
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder
from touchgoal.encoders.backbones.touch_backbone import BaseTouchEncoder, TouchBackbone
from touchgoal.encoders.backbones.vit import ViT
from touchgoal.encoders.pretrained import load_encoder
from touchgoal.encoders.published import find_published
from touchgoal.encoders.towers.efficientnet import EfficientNetLite0, load_efficientnet_lite0
from touchgoal.encoders.towers.towers import imagenet_pixels
from touchgoal.runtime.errors import UserError, install_extra

Frames = UInt8[np.ndarray, "n h w 3"]
Embeddings = Float32[np.ndarray, "_ d"]
Untouched = UInt8[np.ndarray, "h w 3"]


@runtime_checkable  # beartype checks arguments in tests
class Embedder(Protocol):
    """Maps one sensor's frames to embeddings."""

    def __call__(
        self, frames: Frames, background: Untouched, rows: Int[np.ndarray, " k"] | None = None
    ) -> Embeddings:
        """Return the embeddings of some rows of consecutive frames, or of all.

        The background is an untouched frame of the same sensor.
        """
        ...


_PIXELS = 20, 15  # width and height
_CONTRAST = 4  # factor on the colour change, for networks of plain images


def find_embedder(name: str, seed: int) -> Embedder:
    """Find an embedder by name; UserError if there is none. The seed is of random weights.

    Names: a shipped touch encoder, a folder, or a published Sparsh file or id; `random:NAME` for the
    same network untrained; `pixels` for 20 x 15 pixels of change; `efficientnet` for the offline
    towers' ImageNet network; or the id or folder of a Hugging Face vision model.
    """
    if name == "pixels":
        return _one_by_one(_embed_pixels)
    if name == "efficientnet":
        network = load_efficientnet_lite0()
        return _of_images(lambda batch: network.features(imagenet_pixels(batch)))
    if name.startswith("random:"):
        return untrained(name.removeprefix("random:"), seed).embed_frames
    # Names on Hugging Face are OWNER/MODEL; ours have no slash, or are folders.
    foreign = (Path(name) / "config.json").is_file() or ("/" in name and not Path(name).exists())
    if foreign and find_published(name) is None:
        return _hugging_face(name)
    return load_encoder(name).eval().embed_frames


def untrained(name: str, seed: int) -> BaseTouchEncoder:
    """Return a touch encoder's network with random weights."""
    encoder = load_encoder(name)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        if isinstance(encoder, PooledEncoder):
            return PooledEncoder(encoder.config, EfficientNetLite0().eval()).eval()
        fresh = type(encoder)(encoder.config)  # pyright: ignore[reportArgumentType]
    return fresh.eval()


def vit_of(encoder: BaseTouchEncoder) -> ViT:
    """Return the ViT of a touch encoder; UserError if it has none."""
    if isinstance(encoder, TouchEncoder) and isinstance(encoder.backbone, ViT):
        return encoder.backbone
    if isinstance(encoder, TouchBackbone):
        return encoder.vit
    raise UserError(
        f"a {type(encoder).__name__} has no tokens to probe: give an encoder with a ViT"
    )


def _one_by_one(embed_all: Callable[[Frames, Untouched], Embeddings]) -> Embedder:
    """Return an embedder from a function of single frames."""

    def embed(
        frames: Frames, background: Untouched, rows: Int[np.ndarray, " k"] | None = None
    ) -> Embeddings:
        return embed_all(frames if rows is None else frames[rows], background)

    return embed


def _embed_pixels(frames: Frames, background: Untouched) -> Embeddings:
    change = np.abs(frames.astype(np.float32) - background)
    small = [cv2.resize(c, _PIXELS, interpolation=cv2.INTER_AREA) for c in change]
    return np.stack(small).reshape(len(frames), -1)


def difference_images(frames: Frames, background: Untouched) -> Frames:
    """Return the change against the untouched image as an image about grey."""
    change = frames.astype(np.float32) - background
    return np.clip(128 + _CONTRAST * change, 0, 255).astype(np.uint8)


def _of_images(network: Callable[[Frames], torch.Tensor]) -> Embedder:
    @torch.no_grad()
    def embed(frames: Frames, background: Untouched) -> Embeddings:
        return network(difference_images(frames, background)).float().numpy()

    return _one_by_one(embed)


def _hugging_face(name: str) -> Embedder:
    """Return the pooled output of a Hugging Face vision model, or of a model's image tower."""
    try:
        from transformers import AutoImageProcessor, AutoModel
    except ImportError as error:
        raise UserError(f"models of Hugging Face need: {install_extra('towers')}") from error
    try:
        processor: Any = AutoImageProcessor.from_pretrained(name)
        model: Any = AutoModel.from_pretrained(name)
    except (OSError, ValueError) as error:
        raise UserError(
            f"no vision model {name} of Hugging Face can be had here: {str(error).splitlines()[0]}"
        ) from error
    vision = getattr(model, "vision_model", model).eval()

    def network(batch: Frames) -> torch.Tensor:
        output = vision(**processor(images=list(batch), return_tensors="pt"))
        pooled = getattr(output, "pooler_output", None)
        if pooled is None:
            tokens = output.last_hidden_state
            pooled = tokens.mean((2, 3)) if tokens.ndim == 4 else tokens.mean(1)
        return pooled.flatten(1)

    return _of_images(network)
