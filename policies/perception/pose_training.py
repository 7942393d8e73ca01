"""Training of the pose estimator on rendered placements."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import UInt8
from torch import Tensor, nn

from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.encoders.training.checkpoint import checksum
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.encoders.training.trainer import OptimizerConfig, Training, fit
from touchgoal.policies.config import Box, PoseTrainConfig
from touchgoal.policies.perception.placements import Placements
from touchgoal.policies.perception.pose_estimator import PoseEstimator

_HUBER_BETA = 0.3  # standard deviations beyond which an error of the pose counts linearly


def train_pose_estimator(
    estimator: PoseEstimator,
    placements: Placements,
    config: PoseTrainConfig,
    out_dir: Path,
    options: TrainerOptions,
    recipe: dict[str, Any],
) -> None:
    """Train the pose estimator; writes what `trainer.fit` does."""
    estimator.tcp_normalizer.fit_mean_std(placements.tcp)
    estimator.start_normalizer.fit_mean_std(placements.start)

    def batch(rows: Tensor, noise: BatchNoise) -> dict[str, Any]:
        pictures = {
            key: _add_pixel_noise(placements.pictures[key][rows], box, config.pixel_noise, noise)
            for key, box in estimator.config.crops
        }
        return {"pictures": pictures, "tcp": placements.tcp[rows], "start": placements.start[rows]}

    training = Training(
        loss=_PoseLoss(estimator),
        n_samples=len(placements),
        batch=batch,
        optimizer=OptimizerConfig(
            config.epochs, config.batch_size, config.lr, weight_decay=1e-4, max_warmup_steps=50
        ),
        identity={
            "train": asdict(config),
            "pose_estimator": asdict(estimator.config),
            "data": checksum(*placements.pictures.values(), placements.tcp, placements.start),
        },
        progress=lambda metrics: f"pose: loss {metrics['loss']:.4f}",
    )
    fit(training, out_dir, options, recipe)
    estimator.cpu()


class _PoseLoss(nn.Module):
    def __init__(self, estimator: PoseEstimator) -> None:
        super().__init__()
        self.estimator = estimator

    def forward(self, pictures: dict[str, Tensor], tcp: Tensor, start: Tensor) -> dict[str, Tensor]:
        predicted = self.estimator.scaled(pictures, tcp)
        target = self.estimator.start_normalizer(start)
        return {"loss": F.smooth_l1_loss(predicted, target, beta=_HUBER_BETA)}


def _add_pixel_noise(
    pictures: UInt8[Tensor, "b h w 3"], box: Box, counts: int, noise: BatchNoise
) -> UInt8[Tensor, "b h w 3"]:
    """Change the images in the box, and return them."""
    top, bottom, left, right = box
    crop = pictures[:, top:bottom, left:right]
    added = noise.draw(
        len(crop),
        lambda n, g: torch.randint(
            -counts, counts + 1, (n, *crop.shape[1:]), dtype=torch.int16, generator=g
        ),
    )
    crop.copy_((crop + added).clamp(0, 255))
    return pictures


@torch.no_grad()
def pose_errors(estimator: PoseEstimator, placements: Placements) -> dict[str, list[float]]:
    """Return median and 90th percentile of the errors.

    Errors of the object's and the goal's position on the table (mm), of the object's height (mm),
    and of the grasp's yaw (degrees) for objects that are not round.
    """
    predicted, true = estimator(placements.pictures, placements.tcp), placements.start
    off = predicted - true
    twice = torch.atan2(predicted[:, 4], predicted[:, 3]) - torch.atan2(true[:, 4], true[:, 3])
    yaw = torch.rad2deg(torch.atan2(twice.sin(), twice.cos()) / 2).abs()
    errors = {
        "object_mm": 1e3 * off[:, :2].norm(dim=1),
        "goal_mm": 1e3 * off[:, 5:].norm(dim=1),
        "height_mm": 1e3 * off[:, 2].abs(),
        "yaw_degrees": yaw[true[:, 4] != 0],  # round objects are grasped at 0 exactly
    }
    at = torch.tensor([0.5, 0.9])
    return {name: error.quantile(at).tolist() for name, error in errors.items() if len(error)}
