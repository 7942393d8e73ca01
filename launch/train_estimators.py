"""Train the state estimator of pick-and-place: contact from touch, where things lie from pictures."""

import os
from pathlib import Path
from typing import Annotated, Any

from touchgoal.encoders.training.options import TrainingOptions
from touchgoal.policies.config import EstimatorTrainConfig, PoseEstimatorConfig
from touchgoal.runtime.option_types import RARE, Count, checked_dataclass
from touchgoal.sim_envs.config import PickPlaceConfig


@checked_dataclass
class Config(TrainingOptions):
    """Options of train-estimators."""

    data: Path
    """Set of pick-and-place episodes with touch, to learn contact from."""
    validation: Path
    """Set of other episodes, on which errors of contact are measured."""
    out: Path | None = None
    """Folder of the run; the state estimator goes to its `estimator/`."""
    encoder: Path | None = None
    """Folder of a frozen touch encoder (train-encoder), which is copied beside the estimator; default:
    the shipped one, which is not copied."""
    pose: Annotated[Path | None, RARE] = None
    """Folder of a state estimator that goes on finding things in pictures: only contact is learned. After
    the pads have changed, and the cameras have not."""
    objects: Count = 1200
    """Number of objects to look at, of random kind and size."""
    placements: Count = 12
    """Number of places on the table for each object."""
    train: EstimatorTrainConfig = EstimatorTrainConfig()
    """How the networks are trained."""
    pose_estimator: Annotated[PoseEstimatorConfig, RARE] = PoseEstimatorConfig()
    """The network that finds in pictures where things lie."""
    env: Annotated[PickPlaceConfig, RARE] = PickPlaceConfig()
    """Options of the scenes that are rendered."""
    workers: Count = os.cpu_count() or 1
    """Processes that render and embed."""


def main(config: Any) -> None:
    """Place, embed, train, judge."""
    from touchgoal.launch.commands.train_estimators import run_command

    run_command(config)
