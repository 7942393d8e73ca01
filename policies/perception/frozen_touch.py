"""Frozen touch encoder for both fingertips of a policy."""

import hashlib
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from touchgoal.control import features as ft
from touchgoal.encoders import pretrained
from touchgoal.encoders.backbones.frame_history import RecentFrames
from touchgoal.encoders.ssl.frames import check_sensor
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError


class TouchEmbedder:
    """Embedder of both fingertips: the left embedding, then the right one, as one row.

    The background of each is its first frame: episodes start untouched.

    Attributes:
        name: identifies the embeddings, see `PolicyConfig.touch`.
        dim: width of a row; `shape` is (dim,).
        sensor: name of the fingertip sensor; None for any.
        reach: number of earlier ticks that an embedding depends on; 0 with single frames.
    """

    def __init__(self, encoder: pretrained.AnyTouchEncoder, name: str) -> None:
        self.encoder, self.name = encoder, name
        self.dim = len(ft.TACTILE) * encoder.config.embedding_dim
        self.shape = (self.dim,)
        self.sensor = encoder.config.sensor
        self.reach = max(encoder.offsets)
        self._recent = {
            key: RecentFrames(encoder.preprocess, encoder.offsets) for key in ft.TACTILE
        }

    def embed(self, episodes: EpisodeSet, i: int) -> Float32[np.ndarray, "t e"]:
        """Embed all ticks of an episode; UserError if it was recorded with another sensor."""
        if self.sensor is not None:
            check_sensor(episodes, i, self.sensor)
        frames = episodes.read(i, ft.TACTILE).frames
        sides = [self.encoder.embed_frames(frames[k], frames[k][0]) for k in ft.TACTILE]
        return np.concatenate(sides, 1)

    @torch.no_grad()
    def embed_tick(
        self, observations: Sequence[Mapping[str, np.ndarray]], untouched: Mapping[str, np.ndarray]
    ) -> Float32[np.ndarray, " e"]:
        """Embed the latest of the last `1 + reach` ticks, with the same result as `embed`.

        If there are fewer, the oldest is repeated. Frame objects passed in an earlier call are not
        preprocessed again.
        """
        sides = [
            self._recent[key].latest([tick[key] for tick in observations], untouched[key])
            for key in ft.TACTILE
        ]
        return self.encoder.embed_touch(self.encoder.stack(torch.cat(sides))).numpy().ravel()


def load_touch(name_or_path: str | Path) -> TouchEmbedder:
    """Load the embedder of an encoder, a folder or one that ships; UserError if there is none.

    Embeddings are named after the weights, not after the folder, which may move.
    """
    directory = pretrained.find_encoder(name_or_path, published=False)
    encoder = pretrained.load_encoder(directory)
    offsets = encoder.offsets
    frames = f"/frames{'-'.join(map(str, offsets))}" if len(offsets) > 1 else ""
    return TouchEmbedder(encoder, f"{encoder.config.preprocessor}/{_digest(directory)}{frames}")


def load_touch_of(directory: Path, name: str) -> TouchEmbedder:
    """Load the embedder of a policy's training, from its folder or else the shipped one by name.

    UserError: there is none.
    """
    if directory.is_dir():
        return load_touch(directory)
    if shipped := shipped_touch(name):
        return load_touch(shipped)
    raise UserError(f"no touch encoder {name} in {directory}, and none like it ships: train again")


def shipped_touch(name: str) -> str | None:
    """Return the shipped encoder whose embeddings have this `TouchEmbedder.name`, if any."""
    names = pretrained.encoder_names()
    return next((n for n in names if _digest(pretrained.find_encoder(n)) in name), None)


def _digest(directory: Path) -> str:
    path = pretrained.ENCODER_FORMAT.weights_path(directory)
    return _hash_once(path, path.stat().st_mtime_ns)


@cache
def _hash_once(path: Path, modified: int) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]
