"""Senses: they read in touch and pictures what only a simulator knows for sure.

A policy learns on those truths, and acts on what its senses say of them. So the senses can learn
from far more than demonstrations, and the policy from demonstrations without pictures.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor, nn

from touchgoal.control import features as ft
from touchgoal.control.errors import UserError
from touchgoal.encoders import pretrained
from touchgoal.encoders.training.weights import Stored
from touchgoal.policies.actions import Scale
from touchgoal.policies.perception.frozen_touch import TouchEmbedder, load_touch
from touchgoal.policies.perception.pose_estimator import Sight, SightConfig

SENSES = Stored("senses", "senses", "train them with: touchgoal train-estimators")
READ = (ft.TRUTH_CONTACT, ft.TRUTH_START)


@dataclass(frozen=True)
class SensesConfig:
    """What is felt and seen through.

    Attributes:
        touch: names the embedder of the fingertips, see `touch.py`.
        touch_dim: of its embedding of both fingertips.
        sight: of the cameras.
    """

    touch: str
    touch_dim: int
    sight: SightConfig = SightConfig()


class SensesNetwork(nn.Module):
    """One reader of contact for both fingertips, and sight."""

    def __init__(self, config: SensesConfig) -> None:
        """Randomly initialised."""
        super().__init__()
        self.config = config
        one = config.touch_dim // len(ft.TACTILE)
        self.touch_scale, self.touch = Scale((one,)), nn.Linear(one, 1)
        self.sight = Sight(config.sight)

    def contact(self, touch: Float[Tensor, "b e"]) -> Float[Tensor, "b 2"]:
        """Log-odds that each pad touches something, given embeddings of both."""
        sides = touch.unflatten(1, (len(ft.TACTILE), -1))
        return self.touch(self.touch_scale(sides)).squeeze(2)


class Senses:
    """What an observation says of `READ`, as columns of those names.

    Attributes:
        touch: the embedder.
        cameras: columns of pictures looked at.
        camera_size: rows and columns of these.
    """

    def __init__(self, network: SensesNetwork, touch: TouchEmbedder) -> None:
        """For inference; UserError if the embedder is not the training's."""
        if touch.name != network.config.touch:
            raise UserError(
                f"these senses feel through {network.config.touch!r}, not {touch.name!r}: load the "
                "touch encoder that they were trained with"
            )
        self.network, self.touch = network, touch
        self.camera_size = network.config.sight.size
        self.cameras = tuple(key for key, _ in network.config.sight.windows)
        self._start: tuple[Mapping[str, np.ndarray] | None, np.ndarray] = None, np.empty(0)

    @torch.inference_mode()
    def read(
        self, observation: Mapping[str, np.ndarray], first: Mapping[str, np.ndarray]
    ) -> dict[str, Float32[np.ndarray, " n"]]:
        """Whether each pad touches something (probability), and how the episode began.

        Args:
            observation: of a tick.
            first: the episode's first, untouched one, with all of the table in view.
        """
        if self._start[0] is not first:
            pictures = {key: self._picture(key, first[key]) for key in self.cameras}
            tcp = torch.from_numpy(first[ft.TCP_POSE])[None]
            self._start = first, self.network.sight(pictures, tcp)[0].numpy()
        touch = torch.from_numpy(self.touch.embed_tick(observation, first))[None]
        contact = self.network.contact(touch).sigmoid()[0].numpy()
        return {ft.TRUTH_CONTACT: contact, ft.TRUTH_START: self._start[1]}

    def _picture(self, key: str, picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[Tensor, "1 h w 3"]:
        size = self.camera_size
        if picture.shape[:2] != size:
            seen, wanted = (f"{rows} x {columns}" for rows, columns in (picture.shape[:2], size))
            raise UserError(f"{key} is {seen}, the senses learned on {wanted}: set camera_size")
        return torch.from_numpy(picture)[None]


def save_senses(network: SensesNetwork, directory: Path, provenance: dict[str, Any]) -> None:
    """Writes the networks; scales as float32, all else as float16."""
    weights = {name: tensor.detach().cpu() for name, tensor in network.state_dict().items()}
    for name, _ in network.named_parameters():
        weights[name] = weights[name].half()
    SENSES.save(directory, weights, asdict(network.config), provenance)


def load_senses(directory: Path) -> Senses:
    """Reads what `save_senses` wrote, and the touch encoder.

    That is in `touch/` beside, or else the shipped one.

    Raises:
        UserError: nothing there, damaged, or another touch encoder than the training's.
    """
    network = SensesNetwork(SENSES.read_config(directory, _config))
    SENSES.fill(network, directory)
    own = directory / "touch"
    return Senses(network, load_touch(own if own.is_dir() else pretrained.SHIPPED))


def _config(fields: dict[str, Any]) -> SensesConfig:
    sight = fields.pop("sight")
    windows = tuple((key, tuple(box)) for key, box in sight.pop("windows"))
    size = tuple(sight.pop("size"))
    return SensesConfig(**fields, sight=SightConfig(size, windows, **sight))
