"""Training without labels: one loop, four objectives."""

from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import torch

from touchgoal.encoders import pretrained
from touchgoal.encoders.backbones.sparsh import Method, backbone_for
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone
from touchgoal.encoders.ssl import mae
from touchgoal.encoders.ssl.config import DinoConfig, IJepaConfig, MaeConfig, VJepaConfig
from touchgoal.encoders.ssl.dino import Dino
from touchgoal.encoders.ssl.frames import TouchFrames
from touchgoal.encoders.ssl.jepa import IJepa, VJepa
from touchgoal.encoders.ssl.validation import Validation
from touchgoal.encoders.training.checkpoint import checksum
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.encoders.training.trainer import OptimizerConfig, Training, fit, on_first_process
from touchgoal.runtime.errors import UserError

_ENCODER = "encoder"
_OBJECTIVES: dict[type, tuple[Method, Any]] = {
    MaeConfig: ("mae", mae.MaskedAutoencoder),
    DinoConfig: ("dino", Dino),
    IJepaConfig: ("ijepa", IJepa),
    VJepaConfig: ("vjepa", VJepa),
}


def train_unlabelled(
    train: TouchFrames,
    val: TouchFrames,
    config: MaeConfig | DinoConfig | IJepaConfig | VJepaConfig,
    out_dir: Path,
    options: TrainerOptions,
    recipe: dict[str, Any],
) -> TouchBackbone:
    """Train a backbone by the objective of `config`.

    Writes what `trainer.fit` does, and at the end the backbone, or its teacher, to `encoder/`. A
    killed and resumed run ends with the same weights as an uninterrupted one. Returns the backbone
    as saved, for inference, on the CPU. UserError: no such device, a folder that does not fit
    `options.resume`, or a collapsed encoder, which is not saved.

    Args:
        val: Touches of other episodes.
        config: Hyperparameters; their class chooses the objective.
        out_dir: A new run's folder, or one to resume.
        recipe: JSON-able provenance of the touches, stored with the weights.
    """
    method, objective = _OBJECTIVES[type(config)]
    optimizer = _optimizer(config)
    validation, callbacks = None, {}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        if isinstance(config, MaeConfig):
            model = objective(config, train.sensor, train.stride)
            encoder = model.backbone
        else:
            backbone = backbone_for(method, config.vit, train.sensor, train.stride)
            model = objective(config, backbone, optimizer.steps(len(train)))
            encoder = model.teacher
            validation = Validation(model, train, val)
            callbacks = {"after_step": model.update_teacher}
    training = Training(
        loss=model,
        n_samples=len(train),
        batch=lambda rows, noise: {"touch": train.touch[rows], **noise.draw(len(rows), model.draw)},
        optimizer=optimizer,
        identity={
            method: asdict(config),
            "sensor": train.sensor,
            "stride": train.stride,
            "data": checksum(train.touch, val.touch),
        },
        evaluate=validation.metrics if validation else lambda: mae.validate(model, train, val),
        progress=validation.line if validation else mae.progress_line,
        **callbacks,
    )
    history, provenance = fit(training, out_dir, options, recipe)
    if validation and validation.has_collapsed(history[-1]):
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
    on_first_process(lambda: pretrained.save(encoder, out_dir / _ENCODER, provenance))
    return cast(TouchBackbone, pretrained.load_encoder(out_dir / _ENCODER))


def _optimizer(config: MaeConfig | DinoConfig | IJepaConfig | VJepaConfig) -> OptimizerConfig:
    is_mae = isinstance(config, MaeConfig)
    return OptimizerConfig(
        config.epochs,
        config.batch_size,
        config.lr,
        config.weight_decay,
        betas=(0.9, config.second_moment if is_mae else 0.999),
        warmup=config.warmup,
        final_lr=0.0 if is_mae else config.final_lr,
        max_grad_norm=1.0 if is_mae else 10.0,
        final_weight_decay=config.final_weight_decay,
    )
