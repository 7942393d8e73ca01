"""Training of senses: contact in embeddings of touch, the scene in pictures of placements."""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from tqdm import tqdm

from touchgoal.control import features as ft
from touchgoal.encoders.training import checkpoint as resumable
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies.perception.frozen_touch import TouchEmbedder
from touchgoal.policies.perception.placements import Placements
from touchgoal.policies.perception.pose_estimator import PoseEstimator
from touchgoal.policies.perception.state_estimation import StateEstimatorNetwork
from touchgoal.policies.training.sequence_dataset import embed_episodes

_HUBER_BETA = 0.3  # standard deviations beyond which an error of sight counts linearly


@dataclass(frozen=True)
class EstimatorTrainConfig:
    """How senses are trained, by AdamW.

    Attributes:
        steps: of sight.
        batch_size: placements a step of sight.
        lr: highest learning rate of sight, left by a cosine.
        pixel_noise: counts by which each pixel is changed at most, as a camera's are.
        contact_steps: of contact, 256 ticks each at a rate of 1e-3.
        touch_noise: standard deviation of noise added to embeddings, scaled to variance 1.
        seed: of everything random.
    """

    steps: int = 4000
    batch_size: int = 64
    lr: float = 2e-3
    pixel_noise: int = 4
    contact_steps: int = 600
    touch_noise: float = 0.5
    seed: int = 0


def embed_touch_and_contact(
    episodes: EpisodeSet, touch: TouchEmbedder, workers: int
) -> tuple[Float[Tensor, "n e"], Bool[Tensor, "n 2"]]:
    """All ticks of a set: embeddings, which are kept on disk, and whether each pad touched."""
    rows = embed_episodes(episodes, range(len(episodes)), touch, workers)
    truth = [episodes.read(i, [ft.TRUTH_CONTACT]).frames for i in range(len(episodes))]
    contact = np.concatenate([frames[ft.TRUTH_CONTACT] for frames in truth])
    return torch.from_numpy(np.concatenate(rows)).float(), torch.from_numpy(contact)


def train_contact_estimator(
    network: StateEstimatorNetwork,
    touch: Float[Tensor, "n e"],
    contact: Bool[Tensor, "n 2"],
    config: EstimatorTrainConfig,
) -> None:
    """Trains the reader of contact."""
    generator = torch.Generator().manual_seed(config.seed)
    sides = touch.unflatten(1, (len(ft.TACTILE), -1)).flatten(0, 1)
    network.touch_scale.fit_mean_std(sides)
    optimiser = torch.optim.AdamW(network.touch.parameters(), 1e-3)
    spread = network.touch_scale.size.repeat(len(ft.TACTILE))
    for _ in tqdm(range(config.contact_steps), desc="contact"):
        rows = torch.randint(len(touch), (256,), generator=generator)
        noise = torch.randn(len(rows), touch.shape[1], generator=generator)
        predicted = network.contact(touch[rows] + config.touch_noise * spread * noise)
        loss = F.binary_cross_entropy_with_logits(predicted, contact[rows].float())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()


def train_pose_estimator(
    sight: PoseEstimator, placements: Placements, config: EstimatorTrainConfig
) -> None:
    """Trains sight."""
    generator = torch.Generator().manual_seed(config.seed)
    sight.tcp_scale.fit_mean_std(placements.tcp)
    sight.start_scale.fit_mean_std(placements.start)
    optimiser = torch.optim.AdamW(sight.parameters(), config.lr, weight_decay=1e-4)
    progress = tqdm(range(config.steps), desc="sight")
    for step in progress:
        rate = resumable.warmed_cosine(step, config.steps, min(50, config.steps // 10))
        for group in optimiser.param_groups:
            group["lr"] = config.lr * rate
        rows = torch.randint(len(placements), (config.batch_size,), generator=generator)
        pictures = {
            key: _add_pixel_noise(placements.pictures[key][rows], config.pixel_noise, generator)
            for key, _ in sight.config.crops
        }
        predicted = sight.scaled(pictures, placements.tcp[rows])
        wanted = sight.start_scale(placements.start[rows])
        loss = F.smooth_l1_loss(predicted, wanted, beta=_HUBER_BETA)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        progress.set_postfix(loss=f"{loss.item():.4f}")


def _add_pixel_noise(
    pictures: UInt8[Tensor, "b h w 3"], counts: int, generator: torch.Generator
) -> UInt8[Tensor, "b h w 3"]:
    noise = torch.randint(
        -counts, counts + 1, pictures.shape, dtype=torch.int16, generator=generator
    )
    return (pictures + noise).clamp(0, 255).to(torch.uint8)


@torch.no_grad()
def contact_error_rate(
    network: StateEstimatorNetwork, touch: Float[Tensor, "n e"], contact: Bool[Tensor, "n 2"]
) -> float:
    """Share of ticks and pads read wrongly."""
    return float(((network.contact(touch) > 0) != contact).float().mean())


@torch.no_grad()
def pose_errors(sight: PoseEstimator, placements: Placements) -> dict[str, list[float]]:
    """Median and 90th percentile of the errors.

    Returns:
        Of the object's and the goal's position on the table (mm), of the object's height (mm), of
        the grasp's yaw (degrees) where it matters.
    """
    predicted, true = sight(placements.pictures, placements.tcp), placements.start
    off = predicted - true
    twice = torch.atan2(predicted[:, 4], predicted[:, 3]) - torch.atan2(true[:, 4], true[:, 3])
    yaw = torch.rad2deg(torch.atan2(twice.sin(), twice.cos()) / 2).abs()
    errors = {
        "object_mm": 1e3 * off[:, :2].norm(dim=1),
        "goal_mm": 1e3 * off[:, 5:].norm(dim=1),
        "height_mm": 1e3 * off[:, 2].abs(),
        "yaw_degrees": yaw[true[:, 4] != 0],  # round things are grasped at 0 exactly
    }
    at = torch.tensor([0.5, 0.9])
    return {name: error.quantile(at).tolist() for name, error in errors.items() if len(error)}
