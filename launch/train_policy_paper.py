"""Train the bead-maze policy as Sparsh (C.7) and diffusion_policy say: U-Net of 87 M, DDPM, deltas.

The paper's 30 demonstrations of about 34,000 pairs are
`touchgoal collect-demos --task bead-maze --episodes 30 --env.control-hz 50`. It leaves open how many
ticks of a plan are done (here all 8), at what rate, and for how long to train (here the 600 epochs of
diffusion_policy's real-robot tasks). On a CPU this is a matter of days.
"""

from typing import Annotated

from touchgoal.launch import train_policy
from touchgoal.policies.config import (
    ActionRepresentation,
    Head,
    SamplerConfig,
    TouchInput,
    TrainConfig,
)
from touchgoal.runtime.option_types import RARE, Count, NotNegative, checked_dataclass


@checked_dataclass
class Config(train_policy.Config):
    """Options of train-policy, with the published ones as defaults."""

    head: Head = "published"
    representation: ActionRepresentation = "delta"
    touch_input: TouchInput = "embedding"
    touch_projection_dim: Annotated[Count, RARE] = 256
    touch_noise: Annotated[NotNegative, RARE] = 0.0
    position_noise: Annotated[NotNegative, RARE] = 0.0
    execution_horizon: Count = 8
    train: TrainConfig = TrainConfig(epochs=600, lr=1e-4, snapshot_epochs=100)
    sampler: Annotated[SamplerConfig, RARE] = SamplerConfig(
        "ddpm", "epsilon", num_train_timesteps=100, num_inference_steps=100
    )


ENVS = train_policy.ENVS
main = train_policy.main
