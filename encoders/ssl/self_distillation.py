"""What DINO, I-JEPA and V-JEPA share: a teacher that is a moving average of what is trained, and the run.

The teacher is what is kept, measured and saved: it is steadier than its student.
"""

import copy
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from touchgoal.encoders import pretrained
from touchgoal.encoders.backbones.frame_history import stack_frames
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone
from touchgoal.encoders.config import TrainerOptions
from touchgoal.encoders.ssl.config import SelfDistillationConfig
from touchgoal.encoders.ssl.frames import TouchFrames
from touchgoal.encoders.ssl.untrained import Method, backbone_for
from touchgoal.encoders.ssl.validation import Validation
from touchgoal.encoders.training.checkpoint import checksum
from touchgoal.encoders.training.trainer import OptimizerConfig, Training, fit, on_first_process
from touchgoal.runtime.errors import UserError

_ENCODER = "encoder"
_MAX_GRAD_NORM = 10.0


def frozen_copy(module: nn.Module) -> Any:
    """The same, which no gradient reaches."""
    return copy.deepcopy(module).requires_grad_(False)


@torch.no_grad()
def update_average(average: nn.Module, module: nn.Module, momentum: float) -> None:
    """Exponential moving average: average <- momentum * average + (1 - momentum) * module."""
    for mean, weight in zip(average.parameters(), module.parameters(), strict=True):
        mean.lerp_(weight, 1 - momentum)


class SelfDistillation(nn.Module):
    """A backbone that learns from its own moving average; the objective is the subclass's.

    Attributes:
        backbone: What is trained.
        teacher: Its average.
        step: Updates so far; part of the state, so that schedules go on after an interruption.
    """

    step: Int[Tensor, ""]

    def __init__(self, config: SelfDistillationConfig, backbone: TouchBackbone, steps: int) -> None:
        """Builds the teacher, equal to the backbone.

        Args:
            config: For the teacher's momentum.
            backbone: Randomly initialised.
            steps: Updates of the whole training.
        """
        super().__init__()
        self.backbone, self.teacher = backbone, frozen_copy(backbone)
        self.register_buffer("step", torch.zeros((), dtype=torch.long))
        self._momentum, self._steps = (config.momentum, config.final_momentum), max(steps, 1)

    def draw(self, count: int, generator: torch.Generator) -> dict[str, Any]:
        """What is random about a batch of so many touches: `forward`'s further arguments."""
        raise NotImplementedError

    def averaged(self) -> list[tuple[nn.Module, nn.Module]]:
        """Averages, and what they are of."""
        return [(self.teacher, self.backbone)]

    @property
    def done(self) -> float:
        """Share of the training that is done."""
        return min(self.step.item() / self._steps, 1.0)

    def update_teacher(self) -> None:
        """After every update of the weights."""
        first, last = self._momentum
        momentum = first + self.done * (last - first)
        for average, module in self.averaged():
            update_average(average, module, momentum)
        self.step += 1

    def stacked(self, touch: Tensor) -> Float[Tensor, "b c *t h w"]:
        """Touches, the frames of each newest first, as the network takes them."""
        return stack_frames(touch.float(), self.backbone.config.vit)


def train_self_distilled(
    method: Method,
    build: Callable[[TouchBackbone, int], SelfDistillation],
    train: TouchFrames,
    val: TouchFrames,
    config: SelfDistillationConfig,
    out_dir: Path,
    options: TrainerOptions,
    recipe: dict[str, Any],
) -> TouchBackbone:
    """Trains a backbone.

    Writes what `trainer.fit` does, pictures of what can be read from the tokens, and at the end the
    teacher's backbone to `encoder/`. Killed and resumed, it ends with the same weights as
    uninterrupted.

    Args:
        method: Whose network is built.
        build: Makes the objective for a backbone and a number of steps.
        train: Touches to learn from.
        val: Touches of other episodes.
        config: How to train.
        out_dir: A new run's directory, or one to go on with.
        options: Seed, device, precision, whether to go on.
        recipe: JSON-able; where the touches come from, kept with the weights.

    Returns:
        The backbone as saved in `out_dir/encoder`, for inference, on the CPU.

    Raises:
        UserError: No such device, a directory that does not fit `options.resume`, or an encoder that
            gives all touches the same embedding (collapse), which is not saved.
    """
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
        model = build(backbone, optimizer.steps(len(train)))
    validation = Validation(model, train, val, out_dir, config.epochs)

    def batch(rows: Tensor, generator: torch.Generator) -> dict[str, Any]:
        return {"touch": train.touch[rows], **model.draw(len(rows), generator)}

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
            f"the training collapsed: all touches look the same to the teacher (see {out_dir}/metrics.jsonl), "
            f"so no encoder is saved: lower --{method}.lr, or raise --{method}.momentum"
        )
    provenance |= {
        method: asdict(config),
        "touches": {"train": len(train), "val": len(val)},
        "metrics": history[-1],
    }
    on_first_process(lambda: pretrained.save(model.teacher, out_dir / _ENCODER, provenance))
    return pretrained.load_touch_backbone(out_dir / _ENCODER)
