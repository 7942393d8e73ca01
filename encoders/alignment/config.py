"""Options of the alignment of touch with images and texts; light to import, `--help` shows them."""

from typing import Annotated, Literal

from pydantic import Field

from touchgoal.runtime.option_types import (
    RARE,
    Count,
    CountOrNone,
    Fraction,
    NotNegative,
    Positive,
    checked_dataclass,
)

Split = Literal["sample", "press", "object", "sentence"]
"""What is held out of touches of the wand, see `splits`."""


@checked_dataclass
class Augmentation:
    """Random changes of a preprocessed touch that keep the contact as it is.

    No flips and no rotations: every colour of the LEDs comes from its own side, so a mirrored
    GelSight image shows a relief (a dent for a bump) that no contact makes.
    """

    shift: CountOrNone = 0
    """Largest displacement up, down and sideways, px; zeros fill the border."""
    gain: NotNegative = 0.0
    """Largest relative change of each channel's contrast."""
    offset: NotNegative = 0.0
    """Largest change of each channel's brightness, in the preprocessor's units."""
    noise: NotNegative = 0.0
    """Standard deviation of the noise added to each pixel, in the preprocessor's units."""


@checked_dataclass
class AlignConfig:
    """Hyperparameters of the alignment with frozen image and text towers."""

    backbone: Literal["vit-tiny", "vit-small", "vit-huge", "efficientnet"] = "vit-small"
    """Touch backbone: a ViT with random initial weights, or EfficientNet-Lite0 up to stride 16 with
    ImageNet's."""
    embedding_dim: Count = 256
    """Width of an embedding. A CLIP's embeddings have their own width, which is used instead."""
    epochs: Count = 10
    """Passes over the touches."""
    batch_size: Annotated[int, Field(ge=2)] = 128
    """Touches in each step; all of them if there are fewer."""
    optimizer: Literal["adam", "adamw"] = "adamw"
    """adam adds weight decay to the gradient as an L2 term; adamw decouples it."""
    lr: Positive = 1e-3
    """Highest learning rate."""
    weight_decay: NotNegative = 0.05
    """Weight decay of weight matrices and convolutions."""
    warmup: Annotated[Fraction, RARE] = 0.1
    """Share of the steps in which the learning rate rises from 0."""
    final_lr: Annotated[Fraction, RARE] = 0.01
    """Learning rate at the end as a share of `lr`, reached by a cosine; 1 keeps it constant."""
    temperature: Positive = 0.1
    """Temperature of the InfoNCE losses; it is not learned."""
    text_weight: NotNegative = 1.0
    """Weight of the touch-text loss relative to the touch-image loss: lambda in the MMWand paper."""
    image_text_weight: NotNegative = 1.0
    """Weight of the image-text loss, which trains the heads of towers that were not pretrained
    together (offline). A CLIP needs no such heads and skips this loss."""
    symmetric: bool = True
    """Train both directions of each loss; otherwise only touches choose among images and texts."""
    multi_positive: bool = True
    """Count every touch, image and text of the same object as a positive, not the partner alone."""
    no_contact_texts: Annotated[tuple[str, ...], RARE] = (
        "nothing touches the sensor",
        "an untouched gel, no contact",
        "the fingertip feels nothing",
        "free in the air, touching no object",
    )
    """Sentences for touches without contact; with none, these touches are left out."""
    mask_ratio: Annotated[float, Field(ge=0, lt=1)] = 0.5
    """Share of the patches of each touch that the training of a ViT drops. Dropping half of them halves the cost
    and does not harm (FLIP, Li et al. 2023)."""
    augmentation: Annotated[Augmentation, RARE] = Augmentation(
        shift=8, gain=0.2, offset=0.1, noise=0.03
    )
    """Random changes of the touches."""


@checked_dataclass
class HeadsConfig:
    """Training of the heads."""

    epochs: Count = 40
    """Passes over the touches."""
    batch_size: Count = 256
    """Touches in each step."""
    lr: Positive = 2e-3
    """Highest learning rate; it falls to 0 by a cosine."""
    weight_decay: NotNegative = 0.02
    """Decoupled weight decay."""
    temperature: Positive = 0.07
    """Temperature of the InfoNCE losses."""
    text_weight: NotNegative = 1.0
    """Weight of the touch-text loss: lambda in the MMWand paper; 0 leaves it out."""
    text_hidden: CountOrNone = 512
    """Width of the hidden layer beside the linear map of sentences; 0 leaves it out."""


ALIGN_PRESETS: dict[str, AlignConfig] = {
    "default": AlignConfig(),  # 10,000 touches in about 15 minutes on two CPU cores
    # Section V of the MMWand paper. Where the paper is silent: a constant learning rate, no
    # augmentation, no touches without contact. Meant for CLIP towers and a large GPU.
    "paper": AlignConfig(
        backbone="vit-huge",
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
