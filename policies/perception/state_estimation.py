"""State estimation in pick-and-place: contact from touch, and the poses at the start from a camera.

A policy is trained on the simulator's truth and acts on the estimates.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from touchgoal.control import features as ft
from touchgoal.control.tactile.background import Background
from touchgoal.control.tactile.contact import ContactDetector
from touchgoal.encoders.training.weights import WeightsFormat
from touchgoal.policies.config import PoseEstimatorConfig
from touchgoal.policies.perception.pose_estimator import PoseEstimator
from touchgoal.policies.perception.target_words import WORDS_WIDTH, embed
from touchgoal.runtime.errors import UserError

ESTIMATOR_FORMAT = WeightsFormat(
    "estimator", "pose estimator", "train one with: touchgoal train-pose-estimator"
)
_FARTHEST = 4.0  # standard deviations of the hand's start in training
ESTIMATED = (ft.TRUTH_CONTACT, ft.TRUTH_START)


class StateEstimator:
    """Estimator of the columns `ESTIMATED`; it follows one episode after the other.

    Attributes:
        cameras: columns of the camera images that it reads.
        camera_size: rows and columns of these.
        target: the object in words; "" if it is the only one.
    """

    def __init__(self, pose_estimator: PoseEstimator, target: str = "") -> None:
        """Use a network for inference."""
        self.pose_estimator, self.target = pose_estimator, target
        self.camera_size = pose_estimator.config.size
        self.cameras = tuple(key for key, _ in pose_estimator.config.crops)
        self._first: Mapping[str, np.ndarray] | None = None
        self._start = np.empty(0, np.float32)
        self._contact: dict[str, ContactDetector] = {}

    def estimate(
        self, observation: Mapping[str, np.ndarray], first: Mapping[str, np.ndarray]
    ) -> dict[str, Float32[np.ndarray, " n"]]:
        """Return the contact of each pad (1 or 0), and the poses at the start.

        Observations come in order. An episode's first one is untouched and has all of the table in
        view.
        """
        if self._first is not first:
            self._begin(first)
        contact = [detector.update(observation[key]) for key, detector in self._contact.items()]
        return {ft.TRUTH_CONTACT: np.array(contact, np.float32), ft.TRUTH_START: self._start}

    @torch.inference_mode()
    def _begin(self, first: Mapping[str, np.ndarray]) -> None:
        """Begin an episode: estimate its poses, take its untouched gels."""
        pictures = {key: self._picture(key, first[key]) for key in self.cameras}
        tcp = torch.from_numpy(first[ft.TCP_POSE])[None]
        self._check_hand(tcp)
        words = embed([self.target]) if self.target else torch.zeros(1, WORDS_WIDTH)
        self._start = self.pose_estimator(pictures, tcp, words)[0].numpy()
        self._contact = {key: ContactDetector(Background(first[key][None])) for key in ft.TACTILE}
        self._first = first

    def _check_hand(self, tcp: Float32[Tensor, "1 7"]) -> None:
        """Refuse a start from where the hand was not in training: it would pass for a moved camera."""
        away = self.pose_estimator.tcp_normalizer(tcp)[0, :3]
        if away.abs().max() > _FARTHEST:
            usual = self.pose_estimator.tcp_normalizer.inverse(torch.zeros(7))[:3].tolist()
            x, y, z = (round(v, 2) + 0.0 for v in usual)  # -0.0 becomes 0.0
            raise UserError(
                f"the policy must start with the hand near ({x}, {y}, {z}) m, where its pose "
                "estimator was trained: move it there (task.start of a cell file)"
            )

    def _picture(self, key: str, picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[Tensor, "1 h w 3"]:
        size = self.camera_size
        if picture.shape[:2] != size:
            given, wanted = (f"{rows} x {columns}" for rows, columns in (picture.shape[:2], size))
            raise UserError(
                f"{key} is {given}, the policy was trained on {wanted}: make the environment with "
                "load_policy(...).env_config(), or set camera_size"
            )
        return torch.from_numpy(picture)[None]


def load_pose_estimator(directory: Path) -> PoseEstimator:
    """Read a pose estimator for inference; UserError: nothing there, or damaged."""
    network = PoseEstimator(ESTIMATOR_FORMAT.read_config(directory, _config))
    ESTIMATOR_FORMAT.load_weights(network, directory)
    return network


def _config(fields: dict[str, Any]) -> PoseEstimatorConfig:
    fields["crops"] = tuple((key, tuple(box)) for key, box in fields["crops"])
    for name in ("size", "dilations"):
        fields[name] = tuple(fields[name])
    return PoseEstimatorConfig(**fields)
