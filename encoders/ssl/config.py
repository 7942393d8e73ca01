"""Options of self-supervised objectives; light to import, because `touchgoal --help` shows them.

The `paper` presets are Sparsh's Table 2 (Higuera et al. 2024); what it leaves open is as in the
released code, see each objective. The predictors' sizes are those of the released code.
"""

from typing import Annotated, Any, Literal

from pydantic import Field

from touchgoal.runtime.option_types import FIXED, Count, Fraction, Positive, checked_dataclass


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
    """Highest learning rate of AdamW; it rises from 0, then falls by a cosine."""
    warmup: Annotated[float, FIXED] = 0.1  # share of the steps in which the learning rate rises
    # of weight matrices and convolutions, at the start
    weight_decay: Annotated[float, FIXED] = 0.04
    final_weight_decay: Annotated[float, FIXED] = 0.4  # reached by a cosine


@checked_dataclass
class MaeConfig(_UnlabelledConfig):
    """Hyperparameters of masked autoencoding (MAE)."""

    batch_size: Count = 128
    weight_decay: Annotated[float, FIXED] = 0.05
    final_weight_decay: Annotated[float, FIXED] = 0.05
    stacked: bool = False
    """Stack an earlier frame as further input channels, as Sparsh does; `base` needs it."""
    mask_ratio: Annotated[float, Field(ge=0, lt=1)] = 0.5
    """Share of the patches hidden from the backbone."""
    bottleneck: bool = True
    """Decode from the mean of the backbone's tokens alone, so that this mean, which is the embedding,
    must describe the whole image. Otherwise the decoder reads all tokens, as published."""
    decoder_width: Annotated[int, FIXED] = 96  # of the decoder's tokens
    decoder_depth: Annotated[int, FIXED] = 2  # blocks
    decoder_heads: Annotated[int, FIXED] = 4  # of each block; they divide the width
    second_moment: Annotated[float, FIXED] = 0.999  # AdamW's beta 2

    def __post_init__(self) -> None:
        if self.vit == "base" and not self.stacked:
            raise ValueError("base is Sparsh's, which stacks two frames: it needs stacked")


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

    momentum: Fraction = 0.99
    """Momentum of the teacher, the moving average of the student's weights, at the start."""
    final_momentum: Annotated[float, FIXED] = 1.0  # of the teacher, reached linearly
    final_lr: Annotated[float, FIXED] = 1e-3  # share of `lr`


@checked_dataclass
class DinoConfig(SelfDistillationConfig):
    """Hyperparameters of self-distillation without labels (DINO)."""

    local_views: Count = 8
    """Small views of each touch."""
    # Input of the head: a register token, as in Sparsh, or the mean of the patch tokens, which is
    # the embedding that is used afterwards.
    reads: Annotated[Literal["register", "mean"], FIXED] = "mean"
    prototypes: Annotated[int, FIXED] = 1024  # the classes that the teacher makes up
    head_width: Annotated[int, FIXED] = 256  # of the head's two hidden layers
    head_bottleneck: Annotated[int, FIXED] = 64  # width of the vectors compared with prototypes
    # Batch norm in the head's hidden layers. Without it the small preset collapses: an untrained
    # backbone gives most touches nearly the same tokens.
    batch_norm: Annotated[bool, FIXED] = True


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
    """Hyperparameters of I-JEPA and V-JEPA: their predictor of hidden tokens."""

    predictor_width: Annotated[int, FIXED] = 96  # of its tokens, a multiple of 12
    predictor_depth: Annotated[int, FIXED] = 3  # blocks
    predictor_heads: Annotated[int, FIXED] = 4  # of each block; they divide the width


@checked_dataclass
class IJepaConfig(PredictorConfig):
    """Hyperparameters of I-JEPA: predict the tokens of hidden blocks."""


@checked_dataclass
class VJepaConfig(PredictorConfig):
    """Hyperparameters of V-JEPA: predict the tokens of tubes hidden in a clip."""

    small_blocks: Annotated[int, FIXED] = 8  # hidden blocks of the first mask


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
