"""State estimation from touch and camera images: contact, and the poses at the start.

A policy is trained on the simulator's truth and acts on the estimates.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor, nn

from touchgoal.control import features as ft
from touchgoal.encoders import pretrained
from touchgoal.encoders.training.weights import WeightsFormat
from touchgoal.policies.actions import Normalizer
from touchgoal.policies.config import PoseEstimatorConfig
from touchgoal.policies.perception.frozen_touch import TouchEmbedder, load_touch
from touchgoal.policies.perception.pose_estimator import PoseEstimator
from touchgoal.runtime.errors import UserError

ESTIMATOR_FORMAT = WeightsFormat(
    "estimator", "estimator", "train one with: touchgoal train-estimators"
)
ESTIMATED = (ft.TRUTH_CONTACT, ft.TRUTH_START)


@dataclass(frozen=True)
class StateEstimatorConfig:
    """Inputs of a state estimator."""

    touch: str  # names the embedder of the fingertips, see `frozen_touch.py`
    touch_dim: int  # width of its embedding of both fingertips
    pose_estimator: PoseEstimatorConfig = PoseEstimatorConfig()  # for the cameras


class StateEstimatorNetwork(nn.Module):
    """Networks for the contact of each fingertip, and for poses from the first camera images."""

    def __init__(self, config: StateEstimatorConfig) -> None:
        super().__init__()
        self.config = config
        side_dim = config.touch_dim // len(ft.TACTILE)
        self.touch_normalizer, self.contact_head = Normalizer((side_dim,)), nn.Linear(side_dim, 1)
        self.pose_estimator = PoseEstimator(config.pose_estimator)

    def contact(self, touch: Float[Tensor, "b e"]) -> Float[Tensor, "b 2"]:
        """Return the log-odds of contact of each pad, given embeddings of both."""
        sides = touch.unflatten(1, (len(ft.TACTILE), -1))
        return self.contact_head(self.touch_normalizer(sides)).squeeze(2)


class StateEstimator:
    """Estimator of the columns `ESTIMATED`.

    Attributes:
        touch: the embedder.
        cameras: columns of the camera images that it reads.
        camera_size: rows and columns of these.
    """

    def __init__(self, network: StateEstimatorNetwork, touch: TouchEmbedder) -> None:
        """Use a network for inference; UserError if the embedder is not the training's."""
        if touch.name != network.config.touch:
            raise UserError(
                f"the state estimator was trained with the touch encoder {network.config.touch}, "
                f"this is {touch.name}: put the former into `touch/` beside the estimator, or "
                "train it again (touchgoal train-estimators; the shipped one: make pick-place-policy)"
            )
        self.network, self.touch = network, touch
        self.camera_size = network.config.pose_estimator.size
        self.cameras = tuple(key for key, _ in network.config.pose_estimator.crops)
        self._start: tuple[Mapping[str, np.ndarray] | None, np.ndarray] = None, np.empty(0)

    @torch.inference_mode()
    def estimate(
        self, observation: Mapping[str, np.ndarray], first: Mapping[str, np.ndarray]
    ) -> dict[str, Float32[np.ndarray, " n"]]:
        """Return the contact of each pad (1 or 0), and the poses at the start.

        The episode's first observation is untouched and has all of the table in view.
        """
        if self._start[0] is not first:
            pictures = {key: self._picture(key, first[key]) for key in self.cameras}
            tcp = torch.from_numpy(first[ft.TCP_POSE])[None]
            self._start = first, self.network.pose_estimator(pictures, tcp)[0].numpy()
        touch = torch.from_numpy(self.touch.embed_tick([observation], first))[None]
        # 0 or 1, as in training: given probabilities, the policy sometimes stands still
        contact = (self.network.contact(touch)[0] > 0).numpy().astype(np.float32)
        return {ft.TRUTH_CONTACT: contact, ft.TRUTH_START: self._start[1]}

    def _picture(self, key: str, picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[Tensor, "1 h w 3"]:
        size = self.camera_size
        if picture.shape[:2] != size:
            given, wanted = (f"{rows} x {columns}" for rows, columns in (picture.shape[:2], size))
            raise UserError(
                f"{key} is {given}, the policy was trained on {wanted}: make the environment with "
                "load_policy(...).env_config(), or set camera_size"
            )
        return torch.from_numpy(picture)[None]


def load_estimator(directory: Path) -> StateEstimator:
    """Read a state estimator with its touch encoder: in `touch/` beside it, else the shipped one.

    UserError: nothing there, damaged, or another touch encoder than the training's.
    """
    network, own = load_network(directory), directory / "touch"
    return StateEstimator(network, load_touch(own if own.is_dir() else pretrained.DEFAULT_ENCODER))


def load_network(directory: Path) -> StateEstimatorNetwork:
    """Read the networks alone; UserError: nothing there, or damaged."""
    network = StateEstimatorNetwork(ESTIMATOR_FORMAT.read_config(directory, _config))
    ESTIMATOR_FORMAT.load_weights(network, directory)
    return network


def _config(fields: dict[str, Any]) -> StateEstimatorConfig:
    pose_estimator = fields.pop("pose_estimator")
    crops = tuple((key, tuple(box)) for key, box in pose_estimator.pop("crops"))
    size, dilations = (tuple(pose_estimator.pop(name)) for name in ("size", "dilations"))
    pose = PoseEstimatorConfig(size, crops, dilations=dilations, **pose_estimator)
    return StateEstimatorConfig(**fields, pose_estimator=pose)
