"""What `touchgoal train-estimators` does."""

import shutil
from dataclasses import replace

import torch

from touchgoal.control import features as ft
from touchgoal.encoders import pretrained
from touchgoal.encoders.training.checkpoint import has_checkpoint
from touchgoal.encoders.training.run import (
    check_training,
    open_sets,
    open_training,
    recipe,
)
from touchgoal.encoders.training.trainer import is_first_process
from touchgoal.launch.train_estimators import Config
from touchgoal.policies.perception.frozen_touch import load_touch
from touchgoal.policies.perception.placements import render_placements
from touchgoal.policies.perception.state_estimation import (
    StateEstimatorConfig,
    StateEstimatorNetwork,
    load_network,
    save_estimator,
)
from touchgoal.policies.perception.training import (
    contact_error_rate,
    embed_touch_and_contact,
    pose_errors,
    train_contact_estimator,
    train_pose_estimator,
)
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.run_folder import write_json

_CONTACT, _POSE = "contact", "pose"  # folders of the two trainings in that of the run


def run_command(config: Config) -> None:
    """Place, embed, train, judge."""
    check_training(config.trainer, config.out, _CONTACT)
    sets = open_sets(config.data, config.validation)
    encoder = config.encoder or pretrained.DEFAULT_ENCODER
    touch = load_touch(encoder)
    if touch.reach:
        raise UserError(f"an estimator reads single frames, {encoder} looks back: give another")
    out = open_training(config, "train-estimators")
    torch.manual_seed(config.seed)
    kept = load_network(config.pose) if config.pose else None
    seen = kept.config.pose_estimator if kept else config.pose_estimator
    network = StateEstimatorNetwork(StateEstimatorConfig(touch.name, touch.dim, seen))
    provenance = recipe(*sets)
    rows, validation = (
        embed_touch_and_contact(episodes, touch, config.workers) for episodes in sets
    )
    contact_out, pose_out = out / _CONTACT, out / _POSE
    train_contact_estimator(network, *rows, config.train, contact_out, config.trainer, provenance)
    errors: dict = {"contact": contact_error_rate(network, *validation)}
    cameras = tuple(key.removeprefix(ft.IMAGE_PREFIX) for key, _ in seen.crops)
    env = replace(config.env, tactile=False, cameras=cameras, camera_size=seen.size)
    if kept:
        network.pose_estimator = kept.pose_estimator
    else:
        train_pose_estimator(
            network.pose_estimator,
            render_placements(
                env, config.objects, config.placements, seeds.POSE_TRAINING.start, config.workers
            ),
            config.train,
            pose_out,
            replace(config.trainer, resume=config.resume and has_checkpoint(pose_out)),
            provenance,
        )
    if not is_first_process():
        return
    others = render_placements(
        env, max(1, config.objects // 8), 5, seeds.POSE_VALIDATION.start, config.workers
    )
    errors |= pose_errors(network.pose_estimator, others)
    save_estimator(network, out / "estimator", provenance | {"errors": errors})
    if encoder.resolve() != pretrained.DEFAULT_ENCODER.resolve():
        shutil.copytree(encoder, out / "estimator" / "touch", dirs_exist_ok=True)
    write_json(out / "metrics.json", errors)
    print(f"contact: {errors['contact']:.2%} of ticks misread")
    for name, (middle, most) in list(errors.items())[1:]:
        print(f"{name.replace('_', ', ')}: {middle:.1f} (median), {most:.1f} (90 %)")
    print(f"state estimator: {out / 'estimator'}")
