"""Interface of touch encoders, and the backbone that training without labels makes."""

from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8
from torch import Tensor, nn

from touchgoal.encoders.backbones.frame_history import frame_offsets, past_rows
from touchgoal.encoders.backbones.sparsh_input import SparshPreprocessor
from touchgoal.encoders.backbones.vit import ViT, ViTConfig
from touchgoal.encoders.preprocess import Preprocessor, check_images, preprocessor_for
from touchgoal.encoders.towers.towers import Towers, same_towers
from touchgoal.runtime.errors import UserError

BATCH = 64  # frames at once


@dataclass(frozen=True)
class TouchBackboneConfig:
    """Architecture of a backbone, and what it was trained with."""

    vit: ViTConfig  # the ViT
    sensor: str | None  # the fingertip's; None for a published Sparsh encoder, which takes any
    preprocessor: str  # `TactilePreprocessor.id` at training, or one of `sparsh_input.py`
    stride: int = 1  # frames between those stacked (two: six channels) or of a clip (tubelets)

    @classmethod
    def for_sensor(cls, vit: ViTConfig, sensor: str, stride: int = 1) -> "TouchBackboneConfig":
        """Return the config for a sensor and its image size; UserError for an unknown one."""
        preprocess = preprocessor_for(sensor)
        return cls(replace(vit, image_size=preprocess.size), sensor, preprocess.id, stride)

    @property
    def embedding_dim(self) -> int:
        """Return the width of an embedding."""
        return self.vit.width


class BaseTouchEncoder(nn.Module):
    """Interface of all touch encoders; subclasses turn preprocessed frames into embeddings.

    Attributes:
        preprocess: Preprocessor of raw frames.
        offsets: Frames back from the newest for each input frame, newest first: (0,) for single
            frames.
    """

    def __init__(
        self, preprocess: Preprocessor, embedding_dim: int, offsets: tuple[int, ...] = (0,)
    ) -> None:
        super().__init__()
        self.preprocess, self.offsets = preprocess, offsets
        self._width = embedding_dim

    def embed_touch(
        self, touch: Float[Tensor, "n c *t h w"], ids_keep: Int[Tensor, "n k"] | None = None
    ) -> Float[Tensor, "n d"]:
        """Embed the output of `stack`, only the patches in `ids_keep` if given."""
        raise NotImplementedError

    @property
    def towers(self) -> str | None:
        """Return `Towers.name` of the towers whose sentences it embeds, or None."""
        return getattr(self.config, "towers", None)

    def project_text(self, embeddings: Float[Tensor, "n t"]) -> Float[Tensor, "n d"]:
        """Map the text tower's embeddings to touch, as unit vectors."""
        raise NotImplementedError

    @torch.no_grad()
    def embed_text_goal(self, texts: list[str], towers: Towers) -> Float32[np.ndarray, "n d"]:
        """Embed sentences as touch embeddings, to compare with `embed_frames`.

        UserError: the encoder was trained with other towers.
        """
        self.check_towers(towers)
        return self.project_text(towers.embed_texts(texts).to(self.device)).cpu().numpy()

    def check_towers(self, towers: Towers) -> None:
        """Raise UserError unless the encoder was trained with these towers."""
        if self.towers is None or not same_towers(self.towers, towers.name):
            raise UserError(
                f"this touch encoder was trained with the towers {self.towers}, not "
                f"{towers.name}: load those towers, or train an encoder with these"
            )

    def stack(self, frames: Float[Tensor, "n t 3 h w"]) -> Float[Tensor, "n c *t h w"]:
        """Return the network's input from preprocessed frames at `offsets`."""
        return frames[:, 0]

    @property
    def device(self) -> torch.device:
        """Return the device of the weights."""
        return next(chain(self.parameters(), self.buffers())).device

    def embed(
        self, images: np.ndarray, background: np.ndarray | None = None
    ) -> Float32[np.ndarray, "*n d"]:
        """Embed images of one fingertip sensor, from a script.

        The encoder reads the change against the untouched sensor, so it needs an untouched image.

        Args:
            images: RGB images as the sensor gives them, uint8 (height, width, 3) or, in time,
                (n, height, width, 3). Encoders of several frames take the earlier ones among these;
                the first stands for frames before it.
            background: Image of the untouched sensor, (height, width, 3). Default: the first of
                several images, which must then be free of contact.

        Returns:
            (d,) for one image, (n, d) for several; unit vectors from a `TouchEncoder`.

        Raises:
            UserError: Other images, or one image without its background.
        """
        check_images("images", images, ndim=(3, 4))
        single = images.ndim == 3
        frames = images[None] if single else images
        if background is None and single:
            raise UserError(
                "one image needs its background: embed(image, background=untouched), with untouched an "
                "image of the same sensor without contact"
            )
        untouched = frames[0] if background is None else background
        check_images("background", untouched, ndim=(3,))
        if untouched.shape != frames.shape[1:]:
            raise UserError(
                f"the background is {untouched.shape[1]}x{untouched.shape[0]} pixels, the images "
                f"are {frames.shape[2]}x{frames.shape[1]}: take both from the same sensor"
            )
        embedded = self.embed_frames(frames, untouched)
        return embedded[0] if single else embedded

    @torch.no_grad()
    def embed_frames(
        self,
        frames: UInt8[np.ndarray, "n h w 3"],
        background: UInt8[np.ndarray, "h w 3"],
        rows: Int[np.ndarray, " k"] | None = None,
    ) -> Float32[np.ndarray, "k d"]:
        """Embed raw frames of one sensor, in the order of recording, or only those at `rows`.

        The first frame stands for frames before it. UserError: the frames are not of this encoder's
        sensor.
        """
        rows = np.arange(len(frames)) if rows is None else rows
        embedded = np.empty((len(rows), self._width), np.float32)
        for i in range(0, len(rows), BATCH):
            inputs = past_rows(rows[i : i + BATCH], self.offsets)
            once, where = np.unique(inputs, return_inverse=True)
            touch = torch.from_numpy(self.preprocess(frames[once], background))
            stacked = self.stack(touch[torch.from_numpy(where.reshape(inputs.shape))])
            embedded[i : i + BATCH] = self.embed_touch(stacked.to(self.device)).cpu().numpy()
        return embedded


class TouchBackbone(BaseTouchEncoder):
    """ViT whose embedding is the mean of its tokens."""

    def __init__(self, config: TouchBackboneConfig, vit: ViT | None = None) -> None:
        """Wrap a ViT, or a randomly initialised one; UserError for an unknown sensor."""
        if config.sensor is None:
            preprocess = SparshPreprocessor.of(config.preprocessor, config.vit.image_size)
        else:
            preprocess = preprocessor_for(config.sensor)
        offsets = frame_offsets(config.vit, config.stride)
        super().__init__(preprocess, config.embedding_dim, offsets)
        self.config = config
        self.vit = ViT(config.vit) if vit is None else vit

    def embed_touch(
        self, touch: Float[Tensor, "n c *t h w"], ids_keep: Int[Tensor, "n k"] | None = None
    ) -> Float[Tensor, "n d"]:
        """See BaseTouchEncoder."""
        return self.vit.features(touch, ids_keep)

    def stack(self, frames: Float[Tensor, "n t 3 h w"]) -> Float[Tensor, "n c *t h w"]:
        """Return frames as channels of one image, or as a clip for tubelets."""
        return frames.flatten(1, 2) if self.config.vit.tubelet == 1 else frames.transpose(1, 2)
