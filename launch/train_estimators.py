"""Train the state estimator of pick-place: contact from touch, poses from camera images."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from touchgoal.encoders.training.options import TrainingOptions
from touchgoal.policies.config import EstimatorTrainConfig, PoseEstimatorConfig
from touchgoal.runtime.option_types import RARE, Count, checked_dataclass
from touchgoal.sim_envs.config import PickPlaceConfig

_CONTACT, _POSE = "contact", "pose"  # folders of the two trainings in that of the run


@checked_dataclass
class Config(TrainingOptions):
    """Options of train-estimators."""

    data: Path
    """Set of pick-place episodes with touch, to learn contact from."""
    validation: Path
    """Set of other episodes, on which the error of contact is measured."""
    out: Path | None = None
    """Folder of the run; the state estimator goes to its `estimator/`."""
    encoder: Path | None = None
    """Frozen touch encoder: a folder (train-encoder), which is copied beside the estimator;
    default: the shipped one, which is not copied."""
    pose: Annotated[Path | None, RARE] = None
    """For new pads with the same cameras: state estimator whose pose estimator is reused."""
    objects: Count = 1200
    """Number of objects, of random shape and size, to render."""
    placements: Count = 12
    """Number of places on the table for each object."""
    train: EstimatorTrainConfig = EstimatorTrainConfig()
    """Epochs, learning rate, noise."""
    pose_estimator: Annotated[PoseEstimatorConfig, RARE] = PoseEstimatorConfig()
    """Network of the pose estimator."""
    env: Annotated[PickPlaceConfig, RARE] = PickPlaceConfig()
    """Options of the rendered scenes."""
    workers: Count = os.cpu_count() or 1
    """Processes that render and embed."""


def main(config: Config) -> None:
    """Train on contact and on rendered placements, measure the errors."""
    import torch

    from touchgoal.control import features as ft
    from touchgoal.encoders import pretrained
    from touchgoal.encoders.training.checkpoint import has_checkpoint
    from touchgoal.encoders.training.run import check_training, open_sets, open_training, recipe
    from touchgoal.encoders.training.trainer import is_first_process
    from touchgoal.policies.perception import training
    from touchgoal.policies.perception.frozen_touch import load_touch
    from touchgoal.policies.perception.placements import render_placements
    from touchgoal.policies.perception.state_estimation import (
        ESTIMATOR_FORMAT,
        StateEstimatorConfig,
        StateEstimatorNetwork,
        load_network,
    )
    from touchgoal.policies.training.model_selection import copy_parts
    from touchgoal.runtime import seeds
    from touchgoal.runtime.errors import UserError
    from touchgoal.runtime.json_file import write_json

    check_training(config, config.out, _CONTACT)
    sets = open_sets(config.data, config.validation)
    encoder = config.encoder or pretrained.DEFAULT_ENCODER
    touch = load_touch(encoder)
    if touch.reach:
        raise UserError(
            f"{encoder} reads several frames; a state estimator needs one of single frames"
        )
    first_seed = seeds.POSE_TRAINING.first(config.objects, "--objects")
    out = open_training(config, "train-estimators")
    reused = load_network(config.pose) if config.pose else None
    pose_config = reused.config.pose_estimator if reused else config.pose_estimator
    torch.manual_seed(config.seed)
    network = StateEstimatorNetwork(StateEstimatorConfig(touch.name, touch.dim, pose_config))
    provenance = recipe(*sets)
    rows, validation = (training.embed_touch_and_contact(s, touch, config.workers) for s in sets)
    training.train_contact_estimator(
        network, *rows, config.train, out / _CONTACT, config, provenance
    )
    errors: dict = {"contact": training.contact_error_rate(network, *validation)}
    cameras = tuple(key.removeprefix(ft.IMAGE_PREFIX) for key, _ in pose_config.crops)
    env = replace(config.env, tactile=False, cameras=cameras, camera_size=pose_config.size)
    if reused:
        network.pose_estimator = reused.pose_estimator
    else:
        placements = config.objects, config.placements, first_seed, config.workers
        rendered = render_placements(env, *placements)
        options = replace(config, resume=config.resume and has_checkpoint(out / _POSE))
        training.train_pose_estimator(
            network.pose_estimator, rendered, config.train, out / _POSE, options, provenance
        )
    if not is_first_process():
        return
    few = max(1, config.objects // 8)
    others = render_placements(env, few, 5, seeds.POSE_VALIDATION.start, config.workers)
    errors |= training.pose_errors(network.pose_estimator, others)
    found = provenance | {"errors": errors}
    ESTIMATOR_FORMAT.save_half(network, out / "estimator", network.config, found)
    if encoder.resolve() != pretrained.DEFAULT_ENCODER.resolve():
        copy_parts(out / "estimator", {"touch": encoder})
    write_json(out / "metrics.json", errors)
    print(f"contact: wrong in {errors['contact']:.2%} of ticks")
    for name, (middle, most) in list(errors.items())[1:]:
        print(f"{name.replace('_', ', ')}: {middle:.1f} (median), {most:.1f} (90 %)")
    print(f"state estimator: {out / 'estimator'}")
