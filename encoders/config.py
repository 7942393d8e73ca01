"""Options of the trainings of touch encoders; light to import, for `touchgoal --help` shows them."""

from typing import Annotated, Literal

from pydantic import Field

from touchgoal.runtime.option_types import (
    RARE,
    Count,
    CountOrNone,
    Fraction,
    NotNegative,
    Positive,
    Seed,
    checked_dataclass,
)

Precision = Literal["no", "bf16"]
MaskRatio = Annotated[float, Field(ge=0, lt=1)]
"""Share of the patches of a picture that a network does not see."""


@checked_dataclass
class TrainerOptions:
    """What the trainer is told, whatever it trains."""

    seed: Seed = 0
    """Random seed of initial weights, order of the data and noise."""
    device: str = "cpu"
    """Where to train: cpu, cuda, cuda:<number> or mps. Under torchrun each process takes a GPU of its
    own."""
    precision: Annotated[Precision, RARE] = "no"
    """Mixed precision: bf16 computes in bfloat16 where that is safe; weights stay float32. Meant for
    GPUs: a CPU without AVX-512 is 20 times slower with it."""
    resume: bool = False
    """Go on after the last finished epoch of the run in --out."""


@checked_dataclass
class Augmentation:
    """Random changes of a preprocessed touch that leave alone what is felt.

    No flips and no rotations: every colour of the LEDs comes from its own side, so a mirrored
    GelSight image shows a relief (a dent for a bump) that no contact makes.
    """

    shift: CountOrNone = 0
    """Largest displacement up, down and sideways, px; zeros come in."""
    gain: NotNegative = 0.0
    """Largest change of each colour's contrast, as a share of it."""
    offset: NotNegative = 0.0
    """Largest change of each colour's brightness, in the preprocessor's units."""
    noise: NotNegative = 0.0
    """Standard deviation of the noise added to each pixel, in the preprocessor's units."""


@checked_dataclass
class AlignConfig:
    """How to align touch with frozen image and text encoders."""

    vit: Literal["tiny", "small", "huge"] = "small"
    """Size of the touch backbone, a ViT."""
    embedding_dim: Count = 256
    """Width of the shared space, where heads are trained into one."""
    epochs: Count = 10
    """Passes over the touches."""
    batch_size: Annotated[int, Field(ge=2)] = 128
    """Touches in each step; all of them if there are fewer."""
    optimizer: Literal["adam", "adamw"] = "adamw"
    """Adam, with weight decay as an L2 term in the gradient, or AdamW, with decoupled weight decay."""
    lr: Positive = 1e-3
    """Highest learning rate."""
    weight_decay: NotNegative = 0.05
    """Weight decay of weight matrices and convolutions."""
    warmup: Annotated[Fraction, RARE] = 0.1
    """Share of the steps in which the learning rate rises from 0."""
    final_lr: Annotated[Fraction, RARE] = 0.01
    """Learning rate at the end, as a share of `lr`, reached by a cosine; 1 keeps it constant."""
    temperature: Positive = 0.1
    """Temperature of the InfoNCE losses; it is not learned."""
    text_weight: NotNegative = 1.0
    """Weight of the touch-text loss beside the touch-image loss: lambda in the MMWand paper."""
    image_text_weight: NotNegative = 1.0
    """Weight of the image-text loss. It trains the heads of image and text encoders that were not
    pretrained together, and is left out for those that were."""
    symmetric: bool = True
    """Train both directions of each loss; otherwise only touches choose among images and texts."""
    multi_positive: bool = True
    """Count everything of the same object (or with the same sentence) as right, not the partner
    alone."""
    no_contact_texts: Annotated[tuple[str, ...], RARE] = (
        "nothing touches the sensor",
        "an untouched gel, no contact",
        "the fingertip feels nothing",
        "free in the air, touching no object",
    )
    """Sentences for touches without contact; with none, these touches are left out."""
    mask_ratio: MaskRatio = 0.5
    """Share of the patches of each touch that are left out in training. Half of them costs half and
    does not harm (FLIP, Li et al. 2023)."""
    augmentation: Annotated[Augmentation, RARE] = Augmentation(
        shift=8, gain=0.2, offset=0.1, noise=0.03
    )
    """Random changes of the touches."""


ALIGN_PRESETS: dict[str, AlignConfig] = {
    # 10,000 touches in about 15 minutes on two CPU cores
    "default": AlignConfig(),
    # Section V of the paper. What it leaves open is plain here: a constant learning rate, no
    # augmentation, no touches without contact. Meant for CLIP towers and a large GPU.
    "paper": AlignConfig(
        vit="huge",
        epochs=100,
        batch_size=64,
        optimizer="adam",
        lr=1e-4,
        weight_decay=0.05,
        warmup=0.0,
        final_lr=1.0,
        temperature=0.2,
        text_weight=1.0,
        symmetric=False,
        multi_positive=False,
        no_contact_texts=(),
        mask_ratio=0.0,
        augmentation=Augmentation(),
    ),
}


@checked_dataclass
class MaeConfig:
    """How to train a touch backbone by masked autoencoding."""

    vit: Literal["tiny", "compact", "small", "base"] = "compact"
    """Size of the backbone, a ViT; base is the paper's."""
    stacked: bool = False
    """See an earlier frame, too, as further channels of the picture, as Sparsh does."""
    mask_ratio: MaskRatio = 0.5
    """Share of the patches that the backbone does not see."""
    bottleneck: bool = True
    """Give the decoder the mean of the backbone's tokens and nothing else, so that this mean, which is
    the embedding, holds all that is needed to reconstruct the picture. Otherwise the decoder sees all
    tokens, as published."""
    decoder_width: Annotated[Count, RARE] = 96
    """Size of the decoder's tokens."""
    decoder_depth: Annotated[Count, RARE] = 2
    """Number of the decoder's blocks."""
    decoder_heads: Annotated[Count, RARE] = 4
    """Attention heads of each; they divide its width."""
    epochs: Count = 30
    """Passes over the touches."""
    batch_size: Count = 128
    """Touches in each step; all of them if there are fewer."""
    lr: Positive = 1e-3
    """Highest learning rate of AdamW; reached from 0 in `warmup`, left by a cosine to 0."""
    warmup: Annotated[Fraction, RARE] = 0.1
    """Share of the steps in which the learning rate rises from 0."""
    second_moment: Annotated[Fraction, RARE] = 0.999
    """Share of itself that AdamW's mean of squared gradients keeps in each step: beta 2."""
    weight_decay: NotNegative = 0.05
    """Weight decay of weight matrices and convolutions at the start."""
    final_weight_decay: Annotated[NotNegative | None, RARE] = None
    """Weight decay at the end, reached by a cosine; default: as at the start."""

    def __post_init__(self) -> None:
        """Raises OptionError for a network that is not."""
        if self.vit == "base" and not self.stacked:
            raise ValueError("base is Sparsh's, which sees two frames: it goes with stacked")
        if self.decoder_width % self.decoder_heads:
            raise ValueError(
                f"decoder_width {self.decoder_width} must be a multiple of decoder_heads "
                f"{self.decoder_heads}"
            )


# Sparsh's Table 2 (Higuera et al. 2024); what it leaves open is as in the released code, but for the
# decoder's positions, which are learned there.
MAE_PRESETS: dict[str, MaeConfig] = {
    "default": MaeConfig(),
    "paper": MaeConfig(
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
