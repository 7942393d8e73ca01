"""Training of the state estimator: contact from touch embeddings, poses from camera images."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn

from touchgoal.control import features as ft
from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.encoders.training.checkpoint import checksum
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.encoders.training.trainer import OptimizerConfig, Training, fit
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies.config import Box, EstimatorTrainConfig
from touchgoal.policies.perception.frozen_touch import TouchEmbedder
from touchgoal.policies.perception.placements import Placements
from touchgoal.policies.perception.pose_estimator import PoseEstimator
from touchgoal.policies.perception.state_estimation import StateEstimatorNetwork
from touchgoal.policies.training.embedding_cache import embed_episodes

_HUBER_BETA = 0.3  # standard deviations beyond which an error of the pose counts linearly


def embed_touch_and_contact(
    episodes: EpisodeSet, touch: TouchEmbedder, workers: int
) -> tuple[Float[Tensor, "n e"], Bool[Tensor, "n 2"]]:
    """Return touch embeddings of all ticks of a set (cached on disk), and contact of each pad."""
    rows = embed_episodes(episodes, range(len(episodes)), touch, workers)
    truth = [episodes.read(i, [ft.TRUTH_CONTACT]).frames for i in range(len(episodes))]
    contact = np.concatenate([frames[ft.TRUTH_CONTACT] for frames in truth])
    return torch.from_numpy(np.concatenate(rows)).float(), torch.from_numpy(contact)


def train_contact_estimator(
    network: StateEstimatorNetwork,
    touch: Float[Tensor, "n e"],
    contact: Bool[Tensor, "n 2"],
    config: EstimatorTrainConfig,
    out_dir: Path,
    options: TrainerOptions,
    recipe: dict[str, Any],
) -> None:
    """Train the contact head; writes what `trainer.fit` does."""
    sides = touch.unflatten(1, (len(ft.TACTILE), -1)).flatten(0, 1)
    network.touch_normalizer.fit_mean_std(sides)
    noise = config.touch_noise * network.touch_normalizer.scale.repeat(len(ft.TACTILE))

    def batch(rows: Tensor, batch_noise: BatchNoise) -> dict[str, Tensor]:
        drawn = batch_noise.randn((len(rows), touch.shape[1]))
        return {"touch": touch[rows] + noise * drawn, "contact": contact[rows]}

    training = Training(
        loss=_ContactLoss(network),
        n_samples=len(touch),
        batch=batch,
        optimizer=OptimizerConfig(
            config.contact_epochs, 256, 1e-3, weight_decay=1e-2, warmup=0, final_lr=1
        ),
        identity={"train": asdict(config), "data": checksum(touch, contact)},
        progress=lambda metrics: f"contact: loss {metrics['loss']:.4f}",
    )
    network.pose_estimator.requires_grad_(False)  # has its own training
    fit(training, out_dir, options, recipe)
    network.cpu().pose_estimator.requires_grad_(True)


class _ContactLoss(nn.Module):
    def __init__(self, network: StateEstimatorNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, touch: Tensor, contact: Tensor) -> dict[str, Tensor]:
        logits = self.network.contact(touch)
        return {"loss": F.binary_cross_entropy_with_logits(logits, contact.float())}


def train_pose_estimator(
    estimator: PoseEstimator,
    placements: Placements,
    config: EstimatorTrainConfig,
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
def contact_error_rate(
    network: StateEstimatorNetwork, touch: Float[Tensor, "n e"], contact: Bool[Tensor, "n 2"]
) -> float:
    """Return the share of ticks and pads with a wrong contact."""
    return float(((network.contact(touch) > 0) != contact).float().mean())


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
