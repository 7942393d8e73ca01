"""Training by DINO, I-JEPA or V-JEPA: one loop, three objectives."""

from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from touchgoal.encoders import pretrained
from touchgoal.encoders.backbones.sparsh import Method, backbone_for
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone
from touchgoal.encoders.ssl.config import (
    DinoConfig,
    IJepaConfig,
    SelfDistillationConfig,
    VJepaConfig,
)
from touchgoal.encoders.ssl.dino import Dino
from touchgoal.encoders.ssl.frames import TouchFrames
from touchgoal.encoders.ssl.ijepa import IJepa
from touchgoal.encoders.ssl.validation import Validation
from touchgoal.encoders.ssl.vjepa import VJepa
from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.encoders.training.checkpoint import checksum
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.encoders.training.trainer import OptimizerConfig, Training, fit, on_first_process
from touchgoal.runtime.errors import UserError

_ENCODER = "encoder"
_MAX_GRAD_NORM = 10.0
_OBJECTIVES: dict[type[SelfDistillationConfig], tuple[Method, Any]] = {
    DinoConfig: ("dino", Dino),
    IJepaConfig: ("ijepa", IJepa),
    VJepaConfig: ("vjepa", VJepa),
}


def train_self_distilled(
    train: TouchFrames,
    val: TouchFrames,
    config: DinoConfig | IJepaConfig | VJepaConfig,
    out_dir: Path,
    options: TrainerOptions,
    recipe: dict[str, Any],
) -> TouchBackbone:
    """Train a backbone by the objective of `config`.

    Writes what `trainer.fit` does, images reconstructed from the tokens, and at the end the
    teacher's backbone to `encoder/`. Killed and resumed, it ends with the same weights as
    uninterrupted.

    Args:
        train: Training touches.
        val: Touches of other episodes.
        config: Hyperparameters; their class chooses the objective.
        out_dir: A new run's folder, or one to resume.
        options: Seed, device, precision, whether to resume.
        recipe: JSON-able provenance of the touches, stored with the weights.

    Returns:
        The backbone as saved, for inference, on the CPU.

    Raises:
        UserError: No such device, a folder that does not fit `options.resume`, or a collapsed
            encoder, which is not saved.
    """
    method, objective = _OBJECTIVES[type(config)]
    optimizer = OptimizerConfig(
        config.epochs,
        config.batch_size,
        config.lr,
        config.weight_decay,
        warmup=config.warmup,
        final_lr=config.final_lr,
        max_grad_norm=_MAX_GRAD_NORM,
        final_weight_decay=config.final_weight_decay,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        backbone = backbone_for(method, config.vit, train.sensor, train.stride)
        model = objective(config, backbone, optimizer.steps(len(train)))
    validation = Validation(model, train, val, out_dir, config.epochs)

    def batch(rows: Tensor, noise: BatchNoise) -> dict[str, Any]:
        return {"touch": train.touch[rows], **noise.draw(len(rows), model.draw)}

    training = Training(
        loss=model,
        n_samples=len(train),
        batch=batch,
        optimizer=optimizer,
        identity={
            method: asdict(config),
            "sensor": train.sensor,
            "stride": train.stride,
            "data": checksum(train.touch, val.touch),
        },
        evaluate=validation.metrics,
        progress=validation.line,
        after_step=model.update_teacher,
        after_epoch=lambda history, _: validation.draw(len(history)),
    )
    history, provenance = fit(training, out_dir, options, recipe)
    if validation.has_collapsed(history[-1]):
        raise UserError(
            "the training collapsed: the teacher gives all touches the same embedding (see "
            f"{out_dir}/metrics.jsonl), so no encoder is saved: lower --{method}.lr, or raise "
            f"--{method}.momentum"
        )
    provenance |= {
        method: asdict(config),
        "touches": {"train": len(train), "val": len(val)},
        "metrics": history[-1],
    }
    on_first_process(lambda: pretrained.save(model.teacher, out_dir / _ENCODER, provenance))
    return cast(TouchBackbone, pretrained.load_encoder(out_dir / _ENCODER))
