"""A training step of the small MAE as the trainer does it, beside the same written plainly in torch."""

import contextlib
import io
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from touchgoal.benchmarks.config import EncoderSpeedOptions
from touchgoal.benchmarks.plain_torch import PlainMae
from touchgoal.encoders.backbones.vit import patch_grid, random_masking, sinusoidal_positions
from touchgoal.encoders.config import MaeConfig, TrainerOptions
from touchgoal.encoders.ssl.mae import MaskedAutoencoder
from touchgoal.encoders.training.trainer import OptimizerConfig, Training, fit, parameter_groups

_SENSOR = "gelsight_mini"
_GRADIENT = 1.0  # largest norm, as in train_mae


@dataclass(frozen=True)
class MaeStep:
    """Median processor times of an update of the weights, ms.

    Attributes:
        vit: size of the backbone.
        batch_size: touches in each.
        ours, plain: of the trainer; of the same written plainly.
        ratio: the latter over the former.
    """

    vit: str
    batch_size: int
    ours: float
    plain: float
    ratio: float


def measure_mae_step(config: EncoderSpeedOptions) -> MaeStep:
    """Runs of a few steps of each, in turn; drawing the batch and the masks included."""
    mae = MaeConfig(vit=config.mae_vit, batch_size=config.mae_batch_size)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = MaskedAutoencoder(mae, _SENSOR)
        vit = model.backbone.config.vit
        rows, columns = patch_grid(vit)
        plain = PlainMae(model, sinusoidal_positions(rows, columns, mae.decoder_width))
        model = MaskedAutoencoder(mae, _SENSOR)
        touch = torch.randn(2 * mae.batch_size, 3, *vit.image_size).half()

    def batch(rows: Int[Tensor, " b"], generator: torch.Generator) -> dict[str, Tensor]:
        ids_keep = random_masking(vit, len(rows), mae.mask_ratio, generator)
        return {"touch": touch[rows], "ids_keep": ids_keep}

    times: dict[str, list[float]] = {"ours": [], "plain": []}
    for _ in range(config.repeats):
        times["ours"] += _trained(model, batch, len(touch), mae, config.mae_steps)
        times["plain"] += _plainly_trained(plain, batch, len(touch), mae, config.mae_steps)
    ours, other = (1e3 * float(np.median(spent)) for spent in times.values())
    return MaeStep(mae.vit, mae.batch_size, ours, other, other / ours)


def step_line(step: MaeStep) -> str:
    """As people read it."""
    return (
        f"a training step of the {step.vit} MAE, {step.batch_size} touches, fp32, one core: {step.ours:.0f} ms "
        f"({1e3 * step.batch_size / step.ours:.0f} touches/s); plain torch {step.plain:.0f} ms, ratio "
        f"{step.ratio:.2f}"
    )


def _trained(model: MaskedAutoencoder, batch, samples: int, mae: MaeConfig, steps: int):
    """Processor seconds of each step but the first, from one update to the next."""
    ends: list[float] = []
    size = mae.batch_size
    optimizer = OptimizerConfig(1, size, mae.lr, mae.weight_decay, max_grad_norm=_GRADIENT)

    def repeated(rows: Int[Tensor, " b"], generator: torch.Generator) -> dict[str, Tensor]:
        return batch(rows % samples, generator)

    training = Training(
        loss=model,
        n_samples=(steps + 1) * size,
        batch=repeated,
        optimizer=optimizer,
        identity={},
        after_step=lambda: ends.append(time.process_time()),
    )
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        fit(training, Path(folder) / "run", TrainerOptions(), {})
    return np.diff(ends).tolist()


def _plainly_trained(plain: PlainMae, batch, samples: int, mae: MaeConfig, steps: int):
    """The same, as one writes it by hand."""
    generator = torch.Generator().manual_seed(0)
    optimizer = torch.optim.AdamW(parameter_groups(plain, mae.weight_decay), lr=mae.lr)
    plain.train()
    ends: list[float] = []
    for _ in range(steps + 1):
        rows = torch.randperm(samples, generator=generator)[: mae.batch_size]
        drawn = batch(rows, generator)
        loss = plain(drawn["touch"].float(), drawn["ids_keep"])
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(plain.parameters(), _GRADIENT)
        optimizer.step()
        ends.append(time.process_time())
    return np.diff(ends).tolist()
