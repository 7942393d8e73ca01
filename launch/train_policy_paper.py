"""Train the bead-maze policy as Sparsh (C.7) and diffusion_policy say: U-Net of 87 M, DDPM, deltas.

The paper's 30 demonstrations of about 34,000 pairs are
`touchgoal collect-demos --task bead-maze --episodes 30 --env.control-hz 50`. It leaves open how many
ticks of a plan are done (here all 8), at what rate, and for how long to train (here the 600 epochs of
diffusion_policy's real-robot tasks). On a CPU this is a matter of days.
"""

from dataclasses import field

from touchgoal.control.option_types import checked_dataclass
from touchgoal.launch import train_policy
from touchgoal.policies.config import (
    ActionRepresentation,
    SamplerConfig,
    TouchReading,
    TrainConfig,
)


@checked_dataclass
class Config(train_policy.Config):
    """Options of train-policy, with the published ones as defaults."""

    head: train_policy.Head = "published"
    """Size of the diffusion's U-Net."""
    sampler: SamplerConfig = field(
        default_factory=lambda: SamplerConfig(
            "ddpm", "epsilon", num_train_timesteps=100, num_inference_steps=100
        )
    )
    """How the diffusion is trained and sampled."""
    representation: ActionRepresentation = "delta"
    """Of the actions while learning."""
    touch_reading: TouchReading = "free"
    """What the policy makes of a frozen embedding."""
    touch_projection_dim: int = 256
    """Numbers to which a frozen embedding is projected."""
    touch_noise: float = 0.0
    """Of frozen embeddings while learning; none in the paper."""
    position_noise: float = 0.0
    """Of joint and TCP positions while learning; none in the paper."""
    execution_horizon: int = 8
    """Ticks of a plan that are done before the next one."""
    train: TrainConfig = TrainConfig(epochs=600, lr=1e-4, snapshot_epochs=100)
    """The training."""


main = train_policy.main
