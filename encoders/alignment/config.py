"""Options of the alignment of touch with images and texts; light to import, `--help` shows them."""

from typing import Annotated, Literal

from pydantic import Field

from touchgoal.runtime.option_types import FIXED, Count, Positive, checked_dataclass


@checked_dataclass
class Augmentation:
    """Random changes of a preprocessed touch that keep the contact as it is.

    No flips and no rotations: every colour of the LEDs comes from its own side, so a mirrored
    GelSight image shows a relief (a dent for a bump) that no contact makes.
    """

    shift: int = 0  # largest displacement up, down and sideways, px; zeros fill the border
    gain: float = 0.0  # largest relative change of each channel's contrast
    offset: float = 0.0  # largest change of each channel's brightness, the preprocessor's units
    noise: float = 0.0  # standard deviation of each pixel's noise, the preprocessor's units


@checked_dataclass
class AlignConfig:
    """Hyperparameters of the alignment with frozen image and text towers."""

    backbone: Literal["vit-tiny", "vit-small", "vit-huge", "efficientnet"] = "vit-small"
    """Touch backbone: a ViT with random initial weights, or EfficientNet-Lite0 up to stride 16 with
    ImageNet's."""
    epochs: Count = 10
    """Passes over the touches."""
    batch_size: Annotated[int, Field(ge=2)] = 128
    """Touches in each step; all of them if there are fewer."""
    lr: Positive = 1e-3
    """Highest learning rate."""
    embedding_dim: Annotated[int, FIXED] = 256  # a CLIP's embeddings have their own width
    optimizer: Annotated[Literal["adam", "adamw"], FIXED] = "adamw"  # adam: L2 in the gradient
    weight_decay: Annotated[float, FIXED] = 0.05  # of weight matrices and convolutions
    warmup: Annotated[float, FIXED] = 0.1  # share of the steps in which the learning rate rises
    final_lr: Annotated[float, FIXED] = 0.01  # share of `lr`, reached by a cosine; 1: constant
    temperature: Annotated[float, FIXED] = 0.1  # of the InfoNCE losses; not learned
    text_weight: Annotated[float, FIXED] = 1.0  # of the touch-text loss: the MMWand paper's lambda
    symmetric: Annotated[bool, FIXED] = True  # else only touches choose among images and texts
    # Every touch, image and text of the same object is a positive, not the partner alone.
    multi_positive: Annotated[bool, FIXED] = True
    no_contact_texts: Annotated[tuple[str, ...], FIXED] = (  # with none, such touches are left out
        "nothing touches the sensor",
        "an untouched gel, no contact",
        "the fingertip feels nothing",
        "free in the air, touching no object",
    )
    # Share of the patches that the training of a ViT drops. Half of them halves the cost and does
    # not harm (FLIP, Li et al. 2023).
    mask_ratio: Annotated[float, FIXED] = 0.5
    augmentation: Annotated[Augmentation, FIXED] = Augmentation(
        shift=8, gain=0.2, offset=0.1, noise=0.03
    )


@checked_dataclass
class HeadsConfig:
    """Training of the heads."""

    epochs: Count = 40
    """Passes over the touches."""
    # Weight of the touch-text loss, lambda in the MMWand paper; 0 leaves it out.
    text_weight: Annotated[float, FIXED] = 1.0


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
        warmup=0.0,
        final_lr=1.0,
        temperature=0.2,
        symmetric=False,
        multi_positive=False,
        no_contact_texts=(),
        mask_ratio=0.0,
        augmentation=Augmentation(),
    ),
}
