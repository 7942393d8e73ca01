"""Options of the objectives with a teacher; light to import, for `touchgoal --help` shows them.

The `paper` values are Sparsh's Table 2 (Higuera et al. 2024); what it leaves open is as in the released
code, see each objective.
"""

from typing import Annotated, Literal

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

Scale = Annotated[float, Field(gt=0, le=1)]
"""Share of the patches of a picture."""
Scales = Annotated[tuple[Scale, Scale], ORDERED]
"""Least and greatest share of the patches that a block has, drawn for each batch."""


@checked_dataclass
class SelfDistillationConfig:
    """What all objectives with a teacher share: sizes, the optimizer's schedules, the teacher's."""

    vit: Literal["tiny", "compact", "small", "base"] = "compact"
    """Size of the backbone, a ViT; base is the paper's."""
    epochs: Count = 30
    """Passes over the touches."""
    batch_size: Count = 64
    """Touches in each step; all of them if there are fewer."""
    lr: Positive = 1e-3
    """Highest learning rate of AdamW; reached from 0 in `warmup`, left by a cosine."""
    final_lr: Annotated[Fraction, RARE] = 1e-3
    """Learning rate at the end, as a share of `lr`."""
    warmup: Annotated[Fraction, RARE] = 0.1
    """Share of the steps in which the learning rate rises from 0."""
    weight_decay: NotNegative = 0.04
    """Weight decay of weight matrices and convolutions at the start."""
    final_weight_decay: NotNegative = 0.4
    """Weight decay at the end, reached by a cosine."""
    momentum: Fraction = 0.99
    """Share of itself that the teacher keeps in each step at the start; the rest is the student's."""
    final_momentum: Fraction = 1.0
    """The same at the end, reached linearly."""


@checked_dataclass
class DinoConfig(SelfDistillationConfig):
    """How to train a touch backbone by self-distillation without labels (DINO)."""

    reads: Literal["register", "mean"] = "mean"
    """What of a view the head classifies: a register, as in Sparsh, or the mean of its patches' tokens,
    which is the embedding."""
    prototypes: Count = 1024
    """Classes, which have no meaning but what the teacher gives them."""
    head_width: Annotated[Count, RARE] = 256
    """Width of the head's two hidden layers."""
    head_bottleneck: Annotated[Count, RARE] = 64
    """Width of the head's vectors that are compared with prototypes."""
    batch_norm: bool = True
    """Normalise the head's hidden layers over the batch: most touches look much the same to an untrained
    backbone, and without it all soon get the same answer."""
    student_temperature: Positive = 0.1
    """Of the student's distribution over prototypes."""
    teacher_temperature: Positive = 0.07
    """Of the teacher's, which is sharper."""
    first_teacher_temperature: Annotated[Positive, RARE] = 0.04
    """Of the teacher's at the start; it rises linearly."""
    teacher_warmup: Annotated[Fraction, RARE] = 0.07
    """Share of the steps in which the teacher's temperature rises."""
    targets: Literal["centering", "sinkhorn"] = "centering"
    """What keeps the teacher from giving all touches the same class: its mean output is taken away, or
    every batch is spread over all prototypes alike (Sinkhorn-Knopp, as DINOv2 can)."""
    center_momentum: Annotated[Fraction, RARE] = 0.9
    """Share of itself that the mean output keeps in each step."""
    global_scale: Scales = (0.48, 1.0)
    """Of the two large views, which the teacher sees."""
    local_scale: Scales = (0.1, 0.48)
    """Of the small views, which the student alone sees."""
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
    """What I-JEPA and V-JEPA share: the network that says what the teacher sees elsewhere."""

    predictor_width: Annotated[int, Field(ge=12, multiple_of=12)] = 96
    """Size of the predictor's tokens."""
    predictor_depth: Annotated[Count, RARE] = 3
    """Number of its blocks."""
    predictor_heads: Annotated[Count, RARE] = 4
    """Attention heads of each; they divide its width."""
    shortest: Annotated[Positive, RARE] = 0.75
    """Least height over width of a block that is asked for."""
    tallest: Annotated[Positive, RARE] = 1.5
    """Greatest height over width of a block that is asked for."""

    def __post_init__(self) -> None:
        """Raises OptionError for a predictor that cannot be built, or no range."""
        if self.predictor_width % self.predictor_heads:
            raise ValueError(
                f"predictor_width {self.predictor_width} must be a multiple of predictor_heads "
                f"{self.predictor_heads}"
            )
        if self.shortest > self.tallest:
            raise ValueError("shortest must not be above tallest")


@checked_dataclass
class IJepaConfig(PredictorConfig):
    """How to train a touch backbone by predicting what lies in blocks that it does not see (I-JEPA)."""

    context_scale: Scales = (0.85, 1.0)
    """Size of the block that the backbone sees, but for the target blocks."""
    target_scale: Scales = (0.15, 0.2)
    """Size of each target block."""
    target_blocks: Count = 4
    """Target blocks of each picture."""


@checked_dataclass
class VJepaConfig(PredictorConfig):
    """How to train a touch backbone by predicting hidden tubes of a clip (V-JEPA)."""

    small_scale: Annotated[Scale, RARE] = 0.15
    """Size of each of the many blocks that together are hidden in the first of two masks."""
    small_blocks: Count = 8
    """How many of them."""
    large_scale: Annotated[Scale, RARE] = 0.7
    """Size of each of the few large blocks that together are hidden in the second mask."""
    large_blocks: Count = 2
    """How many of them."""


# The predictors' sizes are those of the released code.
IJEPA_PRESETS: dict[str, IJepaConfig] = {
    "default": IJepaConfig(),
    "paper": IJepaConfig(
        vit="base",
        epochs=150,
        batch_size=150,
        lr=6.25e-4,
        final_lr=1.6e-3,
        warmup=0.2,
        momentum=0.996,
        predictor_width=192,
        predictor_depth=6,
        predictor_heads=12,
    ),
}
VJEPA_PRESETS: dict[str, VJepaConfig] = {
    "default": VJepaConfig(),
    "paper": VJepaConfig(
        vit="base",
        epochs=150,
        batch_size=150,
        lr=6.25e-4,
        final_lr=1.6e-3,
        warmup=0.2,
        momentum=0.996,
        predictor_width=384,
        predictor_depth=12,
        predictor_heads=12,
    ),
}
