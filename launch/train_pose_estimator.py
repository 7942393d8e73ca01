"""Train the pose estimator of pick-place on rendered scenes.

Each scene has up to four objects; a sentence says which one is meant. Table and disc have any colour, the
front camera is turned and moved, and the light changed, in most of them; the hand is elsewhere in half.
"""

import os
from dataclasses import replace
from pathlib import Path

from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.policies.config import PoseEstimatorConfig, PoseTrainConfig
from touchgoal.runtime.option_types import Count, checked_dataclass
from touchgoal.sim_envs.config import USUAL_CAMERA, CameraPlacement, PickPlaceConfig


@checked_dataclass
class Config(TrainerOptions):
    """Options of train-pose-estimator."""

    out: Path | None = None
    """Folder of the run; the pose estimator goes to its `estimator/`."""
    scenes: Count = 1400
    """Number of scenes to render, each of four objects of random shape and size."""
    placements: Count = 30
    """Renderings of each scene: objects moved and painted, some of them hidden."""
    train: PoseTrainConfig = PoseTrainConfig()
    """Epochs and learning rate."""
    front_camera: CameraPlacement = USUAL_CAMERA
    """The front camera as calibrate-camera measured yours, in the base frame: x y z (m), quaternion wxyz (z
    looks ahead, y down), vertical field of view (degrees)."""
    workers: Count = os.cpu_count() or 1
    """Processes that render."""


def main(config: Config) -> None:
    """Render placements, train on them, measure the errors on other ones."""
    import torch

    from touchgoal.encoders.training.run import check_run, open_training
    from touchgoal.encoders.training.trainer import is_first_process
    from touchgoal.policies.perception import pose_training
    from touchgoal.policies.perception.placements import NO_VARIETY, Variety, render_placements
    from touchgoal.policies.perception.pose_estimator import PoseEstimator
    from touchgoal.policies.perception.state_estimation import ESTIMATOR_FORMAT
    from touchgoal.runtime import seeds
    from touchgoal.runtime.json_file import write_json
    from touchgoal.runtime.provenance import provenance

    check_run(config, config.out)
    first_seed = seeds.POSE_TRAINING.first(config.scenes, "--scenes")
    out = open_training(config, "train-pose-estimator")
    torch.manual_seed(config.seed)
    network = PoseEstimator(PoseEstimatorConfig(front_camera=config.front_camera))
    known = provenance()
    env = PickPlaceConfig(
        tactile=False,
        cameras=("front",),
        camera_size=network.config.size,
        front_camera=config.front_camera,
    )
    rendered = render_placements(env, config.scenes, config.placements, first_seed, config.workers)
    pose_training.train_pose_estimator(network, rendered, config.train, out, config, known)
    if not is_first_process():
        return
    few, first = max(1, config.scenes // 8), seeds.POSE_VALIDATION.start
    varied = Variety(hand_anywhere=0, hand_over=0)
    others = render_placements(env, few, 10, first + few, config.workers, varied)
    network.config, refused = pose_training.fit_trust(network, others)
    print(f"refused: {refused['good']:.1%} of good estimates, {refused['bad']:.0%} of bad ones")
    errors = {}
    for where, variety in (
        ("as usual", NO_VARIETY),
        ("camera and light changed", replace(NO_VARIETY, changed=1)),
        ("calibrated camera elsewhere", replace(NO_VARIETY, elsewhere=1)),
        ("table and disc of another look", replace(NO_VARIETY, covered=0.5, repainted=1)),
        ("hand over an object", replace(NO_VARIETY, hand_over=1)),
    ):
        others = render_placements(env, few, 10, first, config.workers, variety)
        errors[where] = pose_training.pose_errors(network, others)
        print(f"{where}\n{pose_training.error_table(errors[where])}")
    known |= {"scenes": config.scenes, "errors": errors, "refused": refused}
    ESTIMATOR_FORMAT.save_half(network, out / "estimator", network.config, known)
    write_json(out / "metrics.json", errors)
    print(f"pose estimator: {out / 'estimator'}")
