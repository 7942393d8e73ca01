"""Options of policies and of their trainings; light to import for `touchgoal --help`."""

from typing import Annotated, Literal

from pydantic import Field

from touchgoal.control import features as ft
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import FIXED, Count, Positive, checked_dataclass
from touchgoal.sim_envs.config import USUAL_CAMERA, CameraPlacement

Head = Literal["mlp", "regression", "published", "tiny"]
"""A diffusion head with a multilayer perceptron or a U-Net of that size, or one that predicts a plan directly."""
ArmState = Literal["measured", "commanded"]
ActionRepresentation = Literal["delta", "relative", "absolute", "base_twist", "body_twist"]
"""Representation of a plan; see `train_policy.Config`. "relative" is UMI's word (Chi et al. 2024).
The hand's displacement and rotation (m, rad) are to first order. "base_twist" adds the third
joint's change for the elbow, and hardly depends on the hand's place on the table; with "body_twist"
the elbow goes where the joints move least. The gripper's width is a target in all of them."""
Box = tuple[int, int, int, int]
POLICIES = {
    "expert": "the task's scripted expert, which reads the simulator's state",
    "follower": "bead-maze: a classical controller on the force at the hand",
    "shipped": "the learned policy that ships for the task",
    "pick-place": "the learned policy that ships for pick-place",
    "bead-maze": "the learned policy that ships for bead-maze",
    "fragile-carry": "the learned policy that ships for fragile-carry; in simulation alone",
}
"""Names of policies, and what they are."""


@checked_dataclass
class SamplerConfig:
    """Noise schedule in training, and denoising when a plan is made."""

    kind: Literal["ddpm", "ddim", "flow"] = "ddim"
    """ddpm draws fresh noise at every step (Ho et al. 2020) and predicts the noise, as published; ddim
    draws none (Song et al. 2021); flow goes straight from noise to data (Lipman et al. 2023)."""
    num_train_timesteps: Annotated[int, Field(ge=2)] = 100
    """Steps of the squared-cosine noise schedule (Nichol and Dhariwal 2021)."""
    num_inference_steps: Count = 2
    """Network calls for one plan. Two suffice for ddim, not for ddpm."""
    loss: Literal["squared", "absolute"] = "squared"
    """Error of the network in training: squared, as published, or absolute, which weighs rare large
    motions less."""
    # Prediction of the network: the noise (epsilon), as published, or the clean sample, which needs
    # fewer steps and less training where samples vary little (Ze et al. 2024), and alone serves flow.
    prediction_type: Annotated[Literal["epsilon", "sample"], FIXED] = "sample"
    clip: Annotated[Positive, FIXED] = 1.0  # largest magnitude of a clean sample, normalised

    def __post_init__(self) -> None:
        if self.kind == "flow" and self.prediction_type != "sample":
            raise UserError("a network for flow predicts samples, not epsilon")
        if self.kind != "flow" and self.num_inference_steps > self.num_train_timesteps:
            raise UserError(
                f"num_inference_steps {self.num_inference_steps} exceed num_train_timesteps "
                f"{self.num_train_timesteps}: some would do nothing, so ask for fewer"
            )


@checked_dataclass
class TrainConfig:
    """Training of a policy."""

    epochs: Count = 20
    """Passes over the data."""
    batch_size: Count = 256
    """Sequences in each step; all of them if there are fewer."""
    lr: Positive = 1e-3
    """Highest learning rate of AdamW, after a linear rise from 0 and before a cosine to 0."""
    snapshot_epochs: Count = 10
    """Epochs between two snapshots of the policy; the last epoch makes one, too."""


@checked_dataclass
class PoseEstimatorConfig:
    """Crops of the camera images, and sizes of the networks."""

    # Rows and columns of the camera images, px. With half as many a pixel covers 5 mm of the table,
    # and objects are located to 3 mm at best.
    size: tuple[int, int] = (256, 256)
    # Crop of each camera's images that shows the table: column of the episodes, then rows and
    # columns (from, to; from, to), px.
    crops: tuple[tuple[str, Box], ...] = ((ft.FRONT, (80, 256, 0, 256)),)
    scene_keypoints: int = 16  # of the whole image at half its size: how the camera stands
    finder_channels: int = 48  # maps of the first look, for object and goal; cells of 8 x 8 px
    # Side of the second look, a square around each of them, px. It must hold the largest object
    # where the first look is a cell off.
    look: int = 64
    channels: int = 32  # feature maps of the second look, in cells of 4 x 4 px
    # Dilation of each further layer, cells. Together they must cover the largest object: its shape
    # shows its height.
    dilations: tuple[int, ...] = (1, 2, 4)
    keypoints: int = 16  # of each image, found by a spatial softmax
    keypoint_features: int = 32  # of each keypoint
    width: int = 256  # of the hidden layers that combine them
    # Least share of the first look near the object and near the goal, least length of the vector of the
    # yaw, and least probability of an unmirrored image, in which the estimate is trusted; training sets them.
    sure: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    # Most by which a sentence may fit its object less than some known name does; None until training sets it.
    misfit: float | None = None
    front_camera: CameraPlacement = USUAL_CAMERA  # where it stood in training, up to its changes


@checked_dataclass
class PoseTrainConfig:
    """Training of the pose estimator, by AdamW."""

    epochs: Count = 18
    """Passes over the placements."""
    batch_size: Count = 64
    """Placements in each step."""
    lr: Positive = 2e-3
    """Highest learning rate, before a cosine to 0."""
