"""Touch encoders trained on the touches of a fold, by `train-encoder align`'s loss and loop."""

import tempfile
from dataclasses import asdict, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float

from benchmarks.papers.mmwand.splits import Fold
from touchgoal.encoders.alignment.align import AlignmentLoss, find_vit, make_batch, optimizer_config
from touchgoal.encoders.alignment.config import AlignConfig
from touchgoal.encoders.alignment.data import TouchData, prepare_touch_data
from touchgoal.encoders.alignment.touch_encoder import TouchEncoder, TouchEncoderConfig
from touchgoal.encoders.alignment.wand_set import WandSet
from touchgoal.encoders.ssl.frames import find_sensor_name
from touchgoal.encoders.towers.towers import Towers
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.encoders.training.trainer import Training, fit

Trainable = Literal["vit-small", "efficientnet"]
"""Touch backbones that two cores train on a set of touches."""
_BATCH = 64


def read_touch_data(data: WandSet, towers: Towers) -> TouchData:
    """Read a whole set as training data; touch i has view i. Slow."""
    sensor = find_sensor_name(None, data.episodes)
    return prepare_touch_data(data.touches(np.arange(len(data))), towers, sensor, ())


def train(
    data: TouchData,
    fold: Fold,
    sensor: str,
    towers: Towers,
    config: AlignConfig,
    options: TrainerOptions,
) -> TouchEncoder:
    """Train on the training side of a fold for all epochs; nothing is chosen on the other side.

    Returns the encoder on the CPU.
    """
    own = data.take(torch.from_numpy(fold.train))
    own = replace(own, describes=data.describes & torch.from_numpy(fold.train_text))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        encoder = TouchEncoder(
            TouchEncoderConfig.for_towers(find_vit(config), towers, sensor, config.embedding_dim)
        )
    training = Training(
        loss=AlignmentLoss(encoder, config),
        n_samples=len(own),
        batch=lambda drawn, noise: make_batch(own, drawn, config, noise),
        optimizer=optimizer_config(config),
        identity={"align": asdict(config)},
        progress=lambda m: f"loss {m['loss']:.3f}",
    )
    with tempfile.TemporaryDirectory() as folder:
        fit(training, Path(folder) / "training", options, {})
    return encoder.cpu().eval()


@torch.no_grad()
def embed_fold(
    encoder: TouchEncoder, data: TouchData, fold: Fold
) -> dict[str, Float[np.ndarray, "_ d"]]:
    """Return unit vectors of the test touches, their views, and the test sentences."""
    rows = torch.from_numpy(fold.test)
    image = encoder.project_image(data.images[data.view_index[rows]])
    text = encoder.project_text(data.texts[torch.from_numpy(fold.test_text)])
    return {
        "touch": embed_touches(encoder, data.take(rows)),
        "image": F.normalize(image, dim=1).numpy(),
        "text": F.normalize(text, dim=1).numpy(),
    }


@torch.no_grad()
def embed_touches(encoder: TouchEncoder, data: TouchData) -> Float[np.ndarray, "n d"]:
    """Return unit vectors of all touches."""
    touch = torch.cat([encoder.embed_touch(b.float()) for b in data.touch.split(_BATCH)])
    return F.normalize(touch, dim=1).numpy()
