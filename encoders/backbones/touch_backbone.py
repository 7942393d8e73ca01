"""A touch backbone: a ViT over touch alone, as self-supervision leaves it."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8
from torch import Tensor, nn

from touchgoal.encoders.backbones.frame_history import frame_offsets, past_rows, stack_frames
from touchgoal.encoders.backbones.sparsh_input import SparshPreprocessor
from touchgoal.encoders.backbones.vit import ViT, ViTConfig
from touchgoal.encoders.preprocess import Preprocessor, check_pictures, preprocessor_for
from touchgoal.encoders.towers.towers import Towers, same_towers
from touchgoal.runtime.errors import UserError

BATCH = 64  # frames at once


@dataclass(frozen=True)
class TouchBackboneConfig:
    """What a backbone is and what it was trained with.

    Attributes:
        vit: Its size.
        sensor: Name of the fingertip sensor; None of a published Sparsh encoder, which takes any.
        preprocessor: `TactilePreprocessor.id` in use at training, or one of `sparsh_input.py`.
        stride: Frames from one that an embedding sees to the one before, where it sees several: two on top of each
            other (a ViT of six channels) or a clip (one with tubelets).
    """

    vit: ViTConfig
    sensor: str | None
    preprocessor: str
    stride: int = 1

    @classmethod
    def for_sensor(cls, vit: ViTConfig, sensor: str, stride: int = 1) -> "TouchBackboneConfig":
        """The configuration for a sensor and its pictures' size; UserError for an unknown one."""
        preprocess = preprocessor_for(sensor)
        return cls(replace(vit, image_size=preprocess.size), sensor, preprocess.id, stride)

    @property
    def embedding_dim(self) -> int:
        """Width of an embedding."""
        return self.vit.width

    def find_preprocessor(self) -> Preprocessor:
        """The current one of the sensor; UserError for an unknown sensor."""
        if self.sensor is None:
            return SparshPreprocessor.of(self.preprocessor, self.vit.image_size)
        return preprocessor_for(self.sensor)


class BaseTouchEncoder(nn.Module):
    """What embeds touch, of any kind: subclasses say how preprocessed frames become embeddings.

    Attributes:
        preprocess: raw frames to a network's numbers.
        offsets: how many frames before the newest one lies each that an embedding sees, the newest first: (0,) of
            an encoder of single frames, (0, 5) of one of two that lie 5 apart.
    """

    def __init__(
        self, preprocess: Preprocessor, embedding_dim: int, offsets: tuple[int, ...] = (0,)
    ) -> None:
        """Keeps these."""
        super().__init__()
        self.preprocess, self.offsets = preprocess, offsets
        self._width = embedding_dim

    def embed_touch(
        self, touch: Float[Tensor, "n c *t h w"], ids_keep: Int[Tensor, "n k"] | None = None
    ) -> Float[Tensor, "n d"]:
        """Embeds what `stack` made, of which only the patches in `ids_keep` are seen if given."""
        raise NotImplementedError

    @property
    def towers(self) -> str | None:
        """`Towers.name` of the frozen towers whose sentences it knows; None if it knows no words."""
        return None

    def project_text(self, embeddings: Float[Tensor, "n t"]) -> Float[Tensor, "n d"]:
        """Brings the text tower's embeddings to touch, as unit vectors."""
        raise NotImplementedError

    @torch.no_grad()
    def embed_text_goal(self, texts: list[str], towers: Towers) -> Float32[np.ndarray, "n d"]:
        """Sentences among touches, to be compared with `embed_frames`.

        Raises:
            UserError: The encoder was trained with other towers.
        """
        self.check_towers(towers)
        return self.project_text(towers.embed_texts(texts).to(self.device)).cpu().numpy()

    def check_towers(self, towers: Towers) -> None:
        """Raises UserError unless these are the towers the encoder was trained with."""
        if self.towers is None or not same_towers(self.towers, towers.name):
            raise UserError(
                f"this touch encoder was trained with the towers {self.towers}, not "
                f"{towers.name}: load those towers, or train an encoder with these"
            )

    def stack(self, frames: Float[Tensor, "n t 3 h w"]) -> Float[Tensor, "n c *t h w"]:
        """The network's input: preprocessed frames at `offsets`, put together."""
        return frames[:, 0]

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return next(self.parameters()).device

    def embed(
        self, images: np.ndarray, background: np.ndarray | None = None
    ) -> Float32[np.ndarray, "*n d"]:
        """Embeds pictures of one fingertip sensor: what to call from a script.

        An encoder sees what touch changes, so it needs the same sensor untouched.

        Args:
            images: One RGB picture, uint8 (height, width, 3), values 0 to 255, or several of them
                in time, (n, height, width, 3), as the sensor gives them: any size of its shape. An
                encoder that sees several frames takes the true earlier ones among these; for a
                single picture, and before the first, the earliest there is stands for them.
            background: The same sensor untouched, (height, width, 3). Default: the first of several
                pictures, which must then be free of contact.

        Returns:
            (d,) for one picture, (n, d) for several; unit vectors from a `TouchEncoder`.

        Raises:
            UserError: Anything but such pictures, or one picture without its background.
        """
        check_pictures("images", images, ndim=(3, 4))
        single = images.ndim == 3
        frames = images[None] if single else images
        if background is None and single:
            raise UserError(
                "one picture needs its background: embed(image, background=untouched), where "
                "untouched is a picture of the same sensor with nothing on it"
            )
        untouched = frames[0] if background is None else background
        check_pictures("background", untouched, ndim=(3,))
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
        """Embeds raw frames of one sensor, given the same sensor untouched.

        Args:
            frames: One after the other, as they were recorded. An encoder that sees several takes
                the earlier ones at its `offsets` among these; before the first, that one again.
            background: The sensor untouched.
            rows: Which to embed; all when None.

        Raises:
            UserError: The frames are not of this encoder's sensor.
        """
        rows = np.arange(len(frames)) if rows is None else rows
        embedded = np.empty((len(rows), self._width), np.float32)
        for i in range(0, len(rows), BATCH):
            seen = past_rows(rows[i : i + BATCH], self.offsets)
            once, where = np.unique(seen, return_inverse=True)
            touch = torch.from_numpy(self.preprocess(frames[once], background))
            stacked = self.stack(touch[torch.from_numpy(where.reshape(seen.shape))])
            embedded[i : i + BATCH] = self.embed_touch(stacked.to(self.device)).cpu().numpy()
        return embedded


class TouchBackbone(BaseTouchEncoder):
    """Touch as the mean of a ViT's tokens."""

    def __init__(self, config: TouchBackboneConfig, vit: ViT | None = None) -> None:
        """Around a ViT, or a randomly initialised one; UserError for an unknown sensor."""
        offsets = frame_offsets(config.vit, config.stride)
        super().__init__(config.find_preprocessor(), config.embedding_dim, offsets)
        self.config = config
        self.vit = ViT(config.vit) if vit is None else vit

    def embed_touch(
        self, touch: Float[Tensor, "n c *t h w"], ids_keep: Int[Tensor, "n k"] | None = None
    ) -> Float[Tensor, "n d"]:
        """See BaseTouchEncoder."""
        return self.vit.features(touch, ids_keep)

    def stack(self, frames: Float[Tensor, "n t 3 h w"]) -> Float[Tensor, "n c *t h w"]:
        """See BaseTouchEncoder."""
        return stack_frames(frames, self.config.vit)
