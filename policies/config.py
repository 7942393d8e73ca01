"""Options of policies and of their trainings; light to import, for `touchgoal --help` shows them."""

from typing import Annotated, Literal

from pydantic import Field

from touchgoal.control import features as ft
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import (
    RARE,
    Count,
    CountOrNone,
    Fraction,
    NotNegative,
    Positive,
    checked_dataclass,
)

Head = Literal["small", "published", "tiny", "regression"]
"""A diffusion head with a U-Net of that size, or one that predicts a plan directly."""
ArmState = Literal["measured", "commanded"]
"""What a policy sees of the arm: where it was measured, or where it has been sent."""
TouchInput = Literal["wrench", "embedding"]
"""What of a frozen touch embedding reaches the head: the wrenches read out of it, or it itself, projected."""
ActionRepresentation = Literal["delta", "relative", "absolute", "base_twist", "body_twist"]
"""Of the joints: each tick's change; the change since the plan's start (UMI's word, Chi et al. 2024); the
joint positions that these changes lead to from the measured ones; the hand's displacement and turn
since the plan's start (m, rad, base frame, to first order) with the third joint's change for the elbow,
which is nearly the same wherever on the table the hand does the same; the hand's displacement and turn
along its own axes, the elbow going where the joints move least. The gripper's width is a target in all five."""
Box = tuple[int, int, int, int]


@checked_dataclass
class SamplerConfig:
    """How samples are noised in training and denoised in use."""

    kind: Literal["ddpm", "ddim", "flow"] = "ddim"
    """ddpm draws fresh noise at every step (Ho et al. 2020), ddim none (Song et al. 2021); both learn
    the same, so a network trained for one serves the other. flow goes straight from noise to data
    (Lipman et al. 2023)."""
    prediction_type: Literal["epsilon", "velocity", "sample"] = "sample"
    """What the network predicts: the noise (epsilon) or the flow's velocity, as published, or the
    clean sample. The last needs fewer steps and less training where samples vary little (3D diffusion
    policy, Ze et al. 2024)."""
    num_train_timesteps: Annotated[int, Field(ge=2)] = 100
    """Steps of the squared-cosine noise schedule (Nichol and Dhariwal 2021)."""
    num_inference_steps: Count = 2
    """Network calls for one plan. Two suffice for ddim with sample (docs/results.md); ddpm with
    epsilon wants more."""
    clip: Positive = 1.0
    """Largest magnitude of a clean sample, in the scale that the policy learns in."""

    def __post_init__(self) -> None:
        """Raises UserError for what makes no sampler."""
        if self.prediction_type == ("epsilon" if self.kind == "flow" else "velocity"):
            raise UserError(
                f"a network for {self.kind} cannot predict {self.prediction_type}: try sample"
            )
        if self.kind != "flow" and self.num_inference_steps > self.num_train_timesteps:
            raise UserError(
                f"num_inference_steps {self.num_inference_steps} exceed num_train_timesteps "
                f"{self.num_train_timesteps}: some would do nothing, so ask for fewer"
            )


@checked_dataclass
class TrainConfig:
    """How to train a policy."""

    epochs: Count = 60
    """Passes over the data."""
    batch_size: Count = 256
    """Sequences in each step; all of them if there are fewer."""
    lr: Positive = 5e-4
    """Highest learning rate of AdamW; reached from 0, left by a cosine to 0."""
    betas: Annotated[tuple[Fraction, Fraction], RARE] = (0.95, 0.999)
    """Decay rates of AdamW's running means of gradients and of their squares."""
    weight_decay: Annotated[NotNegative, RARE] = 1e-6
    """Weight decay of weight matrices and convolutions."""
    warmup: Annotated[CountOrNone, RARE] = 500
    """Steps in which the learning rate rises; a tenth of the training if that is shorter."""
    snapshot_epochs: Count = 10
    """Epochs between two snapshots of the policy; the last epoch is one too."""
    validation_windows: Annotated[Count, RARE] = 1024
    """Number of validation sequences on which losses are measured, evenly spaced."""


@checked_dataclass
class PoseEstimatorConfig:
    """Where in the pictures to look, and the size of the networks."""

    size: tuple[Count, Count] = (256, 256)
    """Rows and columns of the cameras' pictures, px. With half as many the table is seen at 5 mm a
    pixel, and an object's place is told no better than to 3 mm."""
    crops: tuple[tuple[str, Box], ...] = ((ft.FRONT, (104, 232, 16, 240)),)
    """Part of each camera's pictures in which the table is seen: column of the episodes, then rows and
    columns (from, to; from, to), px."""
    channels: Count = 32
    """Feature maps of a picture; each of their cells covers 4 x 4 pixels."""
    dilations: tuple[Count, ...] = (1, 2, 4)
    """How far each further layer looks around a cell, in cells; together as far as the largest object
    is wide, or what it is, and so how high, cannot be told."""
    keypoints: Count = 16
    """Places found in each picture, by a spatial softmax."""
    keypoint_features: Count = 32
    """Numbers that describe what is seen at each of these places."""
    width: Count = 256
    """Width of the hidden layer that combines them."""


@checked_dataclass
class EstimatorTrainConfig:
    """How the state estimator is trained, by AdamW."""

    epochs: Count = 20
    """Passes over the placements, for the pose estimator."""
    batch_size: Count = 64
    """Placements in each step."""
    lr: Positive = 2e-3
    """Highest learning rate of the pose estimator, left by a cosine."""
    pixel_noise: CountOrNone = 4
    """Largest change of a pixel by noise, as a camera's, grey levels of 255."""
    contact_epochs: Count = 4
    """Passes over the control ticks, for contact: 256 ticks in each step, at a learning rate of
    1e-3."""
    touch_noise: NotNegative = 0.5
    """Standard deviation of the noise added to touch embeddings, in theirs."""
