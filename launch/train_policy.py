"""Train a policy on recorded episodes; choose among its snapshots by trials in the task."""

import os
from pathlib import Path
from typing import Annotated, Any

from touchgoal.encoders.training.options import TrainingOptions
from touchgoal.policies.config import (
    ActionRepresentation,
    ArmState,
    Head,
    SamplerConfig,
    TouchInput,
    TrainConfig,
)
from touchgoal.runtime.option_types import (
    RARE,
    Count,
    CountOrNone,
    Fraction,
    NotNegative,
    checked_dataclass,
)
from touchgoal.sim_envs.config import BeadMazeConfig, PickPlaceConfig, TaskConfig, TaskName

ENVS: dict[TaskName, TaskConfig] = {
    "bead-maze": BeadMazeConfig(split="validation"),
    "pick-place": PickPlaceConfig(),
}
"""Options of the environment of each task, unless others are typed."""


@checked_dataclass
class Config(TrainingOptions):
    """Options of train-policy."""

    data: Path
    """Set of episodes to learn from: those that succeeded, and those in which an expert corrected a
    policy."""
    validation: Path
    """Set of other episodes, on which losses are measured."""
    include_unknown: Annotated[bool, RARE] = False
    """Also learn from episodes that do not say whether they succeeded."""
    task: TaskName | None = None
    """Task of the episodes, in which snapshots are tried; default: what the episodes say."""
    encoder: Path | None = None
    """Folder of a frozen touch encoder (train-encoder), or the name of one that ships; without one the
    policy does not feel."""
    end_to_end: bool = False
    """Feel through a touch ViT that is trained jointly with the policy, instead of a frozen encoder."""
    estimator: Path | None = None
    """Folder of a state estimator (train-estimators): the policy acts on its estimates of contact and
    of where things lie at the start, and learns on the truth, so its episodes need no pictures."""
    out: Path | None = None
    """Folder of the run; the policy goes to its `policy/`."""
    share: Annotated[Fraction, RARE] = 1.0
    """Share of the episodes to learn from, counted from the first; 1 takes all."""
    head: Head = "small"
    """Size of the U-Net of a diffusion policy, or regression, which predicts plans directly."""
    representation: ActionRepresentation = "body_twist"
    """How actions are written while learning: delta (joint change of each control tick), relative (since
    the plan's start), absolute (joint positions), base_twist or body_twist (displacement and turn of
    the hand along the base's or the hand's own axes). body_twist also sees what moves along the hand's
    axes; with a state estimator take base_twist."""
    arm_state: ArmState = "measured"
    """How the policy knows where the arm is: measured, or commanded (where it has been sent), into which
    no delay comes; episodes need the column observation.command for that."""
    touch_input: TouchInput = "wrench"
    """What the policy takes from a frozen touch embedding: wrench, the forces and torques on both
    fingertips, which a small network learns from what the simulator says; or embedding, a projection of it
    that is learned from the actions alone."""
    touch_projection_dim: Annotated[Count, RARE] = 64
    """Numbers to which a frozen embedding is projected, with --touch-input embedding."""
    touch_noise: Annotated[NotNegative, RARE] = 0.1
    """Noise added to touch embeddings while learning, relative to their standard deviation."""
    position_noise: Annotated[NotNegative, RARE] = 0.3
    """Noise added to joint and hand positions while learning, where the policy sees them, relative to
    their standard deviation."""
    observation_horizon: Annotated[Count, RARE] = 2
    """Control ticks that the policy sees, the latest included."""
    execution_horizon: Count = 2
    """Control ticks of a plan that are done before the next plan."""
    train: TrainConfig = TrainConfig()
    """How long and how fast to learn."""
    sampler: Annotated[SamplerConfig, RARE] = SamplerConfig()
    """How the diffusion is trained and sampled."""
    trials: CountOrNone = 24
    """Number of validation episodes in which every snapshot is tried; 0 keeps the last snapshot."""
    env: PickPlaceConfig | BeadMazeConfig = ENVS["bead-maze"]
    """Options of the task in which snapshots are tried; name it with --task."""
    workers: Count = os.cpu_count() or 1
    """Processes that simulate."""


def main(config: Any) -> None:
    """Embed, train, choose."""
    from touchgoal.launch.commands.train_policy import run_command

    run_command(config)
