"""Options of self-supervised objectives; light to import, because `touchgoal --help` shows them.

The `paper` presets are Sparsh's Table 2 (Higuera et al. 2024); what it leaves open is as in the
released code, see each objective. The predictors' sizes are those of the released code.
"""

from typing import Annotated, Any, Literal

from pydantic import Field

from touchgoal.runtime.option_types import (
    ORDERED,
    RARE,
    Count,
    Fraction,
    NotNegative,
    Positive,
    checked_dataclass,
)

Scale = Annotated[float, Field(gt=0, le=1)]  # share of the patches of an image
Scales = Annotated[tuple[Scale, Scale], ORDERED]
"""Least and greatest share of the patches in a block, drawn for each batch."""


def _check_heads(network: str, width: int, heads: int) -> None:
    if width % heads:
        raise ValueError(f"{network}_width {width} must be a multiple of {network}_heads {heads}")


@checked_dataclass
class _UnlabelledConfig:
    """Hyperparameters that all objectives share."""

    vit: Literal["tiny", "compact", "small", "base"] = "compact"
    """Size of the backbone, a ViT; base is the paper's."""
    epochs: Count = 30
    """Passes over the touches."""
    batch_size: Count = 64
    """Touches in each step; all of them if there are fewer."""
    lr: Positive = 1e-3
    """Highest learning rate of AdamW; it rises from 0 during `warmup`, then falls by a cosine."""
    warmup: Annotated[Fraction, RARE] = 0.1
    """Share of the steps in which the learning rate rises from 0."""
    weight_decay: NotNegative = 0.04
    """Weight decay of weight matrices and convolutions at the start."""


@checked_dataclass
class MaeConfig(_UnlabelledConfig):
    """Hyperparameters of masked autoencoding (MAE)."""

    batch_size: Count = 128
    weight_decay: NotNegative = 0.05
    final_weight_decay: Annotated[NotNegative | None, RARE] = None
    """Weight decay at the end, reached by a cosine; default: as at the start."""
    stacked: bool = False
    """Stack an earlier frame as further input channels, as Sparsh does; `base` needs it."""
    mask_ratio: Annotated[float, Field(ge=0, lt=1)] = 0.5
    """Share of the patches hidden from the backbone."""
    bottleneck: bool = True
    """Decode from the mean of the backbone's tokens alone, so that this mean, which is the embedding,
    must describe the whole image. Otherwise the decoder reads all tokens, as published."""
    decoder_width: Annotated[Count, RARE] = 96
    """Width of the decoder's tokens."""
    decoder_depth: Annotated[Count, RARE] = 2
    """Number of the decoder's blocks."""
    decoder_heads: Annotated[Count, RARE] = 4
    """Attention heads of each decoder block; they divide the decoder's width."""
    second_moment: Annotated[Fraction, RARE] = 0.999
    """AdamW's beta 2: decay of its running mean of squared gradients."""

    def __post_init__(self) -> None:
        if self.vit == "base" and not self.stacked:
            raise ValueError("base is Sparsh's, which stacks two frames: it needs stacked")
        _check_heads("decoder", self.decoder_width, self.decoder_heads)


MAE_PRESETS: dict[str, MaeConfig] = {
    "default": MaeConfig(),
    "paper": MaeConfig(  # As released, but for the decoder's positions, which are learned there.
        vit="base",
        stacked=True,
        mask_ratio=0.75,
        bottleneck=False,
        decoder_width=512,
        decoder_depth=8,
        decoder_heads=16,
        epochs=150,
        batch_size=100,
        lr=1e-4,
        warmup=0.2,
        second_moment=0.95,
        weight_decay=0.04,
        final_weight_decay=0.4,
    ),
}


@checked_dataclass
class SelfDistillationConfig(_UnlabelledConfig):
    """Hyperparameters that DINO, I-JEPA and V-JEPA share: the teacher and schedules."""

    final_lr: Annotated[Fraction, RARE] = 1e-3
    """Learning rate at the end as a share of `lr`."""
    final_weight_decay: NotNegative = 0.4
    """Weight decay at the end, reached by a cosine."""
    momentum: Fraction = 0.99
    """Momentum of the teacher, the moving average of the student's weights, at the start."""
    final_momentum: Fraction = 1.0
    """Momentum of the teacher at the end, reached linearly."""


@checked_dataclass
class DinoConfig(SelfDistillationConfig):
    """Hyperparameters of self-distillation without labels (DINO)."""

    reads: Literal["register", "mean"] = "mean"
    """Input of the DINO head: a register token, as in Sparsh, or the mean of the patch tokens, which is
    the embedding that is used afterwards."""
    prototypes: Count = 1024
    """Number of prototypes, the classes that the teacher makes up."""
    head_width: Annotated[Count, RARE] = 256
    """Width of the head's two hidden layers."""
    head_bottleneck: Annotated[Count, RARE] = 64
    """Width of the vectors that are compared with the prototypes."""
    batch_norm: bool = True
    """Use batch norm in the head's hidden layers. Without it the small presets collapse: an untrained
    backbone gives most touches nearly the same tokens."""
    student_temperature: Positive = 0.1
    """Temperature of the student's distribution over prototypes."""
    teacher_temperature: Positive = 0.07
    """Temperature of the teacher's distribution, which is sharper."""
    first_teacher_temperature: Annotated[Positive, RARE] = 0.04
    """Teacher's temperature at the start; it rises linearly."""
    teacher_warmup: Annotated[Fraction, RARE] = 0.07
    """Share of the steps in which the teacher's temperature rises."""
    center_momentum: Annotated[Fraction, RARE] = 0.9
    """Momentum of the teacher's mean output, which is subtracted against collapse."""
    global_scale: Scales = (0.48, 1.0)
    """Size of the two large views, the teacher's input, as a share of the patches."""
    local_scale: Scales = (0.1, 0.48)
    """Size of the small views, which only the student gets, as a share of the patches."""
    local_views: Count = 8
    """Small views of each touch."""


DINO_PRESETS: dict[str, DinoConfig] = {
    "default": DinoConfig(),
    "paper": DinoConfig(
        vit="base",
        epochs=150,
        batch_size=150,
        lr=1e-4,
        final_lr=0.01,
        warmup=0.2,
        momentum=0.998,
        final_momentum=0.998,
        reads="register",
        prototypes=65_536,
        head_width=2048,
        head_bottleneck=256,
        batch_norm=False,
    ),
}


@checked_dataclass
class PredictorConfig(SelfDistillationConfig):
    """Hyperparameters of the predictor in I-JEPA and V-JEPA."""

    predictor_width: Annotated[int, Field(ge=12, multiple_of=12)] = 96
    """Width of the predictor's tokens."""
    predictor_depth: Annotated[Count, RARE] = 3
    """Number of the predictor's blocks."""
    predictor_heads: Annotated[Count, RARE] = 4
    """Attention heads of each predictor block; they divide its width."""
    shortest: Annotated[Positive, RARE] = 0.75
    """Least height over width of a target block."""
    tallest: Annotated[Positive, RARE] = 1.5
    """Greatest height over width of a target block."""

    def __post_init__(self) -> None:
        _check_heads("predictor", self.predictor_width, self.predictor_heads)
        if self.shortest > self.tallest:
            raise ValueError("shortest must not be above tallest")


@checked_dataclass
class IJepaConfig(PredictorConfig):
    """Hyperparameters of I-JEPA: predict the tokens of hidden blocks."""

    context_scale: Scales = (0.85, 1.0)
    """Size of the context block, from which the target blocks are cut out, as a share of the patches."""
    target_scale: Scales = (0.15, 0.2)
    """Size of each target block, as a share of the patches."""
    target_blocks: Count = 4
    """Target blocks of each image."""


@checked_dataclass
class VJepaConfig(PredictorConfig):
    """Hyperparameters of V-JEPA: predict the tokens of tubes hidden in a clip."""

    small_scale: Annotated[Scale, RARE] = 0.15
    """Size of each hidden block of the first mask, as a share of the patches."""
    small_blocks: Count = 8
    """Hidden blocks of the first mask."""
    large_scale: Annotated[Scale, RARE] = 0.7
    """Size of each hidden block of the second mask, as a share of the patches."""
    large_blocks: Count = 2
    """Hidden blocks of the second mask."""


_JEPA_PAPER: dict[str, Any] = {
    "vit": "base",
    "epochs": 150,
    "batch_size": 150,
    "lr": 6.25e-4,
    "final_lr": 1.6e-3,
    "warmup": 0.2,
    "momentum": 0.996,
    "predictor_heads": 12,
}
IJEPA_PRESETS: dict[str, IJepaConfig] = {
    "default": IJepaConfig(),
    "paper": IJepaConfig(**_JEPA_PAPER, predictor_width=192, predictor_depth=6),
}
VJEPA_PRESETS: dict[str, VJepaConfig] = {
    "default": VJepaConfig(),
    "paper": VJepaConfig(**_JEPA_PAPER, predictor_width=384, predictor_depth=12),
}
