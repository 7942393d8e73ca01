"""Train a policy on recorded episodes; choose among its snapshots by trials in the task."""

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, cast

from touchgoal.control import features as ft
from touchgoal.encoders.training.options import TrainingOptions
from touchgoal.policies.config import (
    ActionRepresentation,
    ArmState,
    Head,
    SamplerConfig,
    TrainConfig,
)
from touchgoal.policies.training.action_meaning import ActionMeaning, check_actions
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
from touchgoal.sim_envs.config import TASKS, BeadMazeConfig, TaskConfig, TaskName

if TYPE_CHECKING:
    from touchgoal.episodes.store import EpisodeSet
    from touchgoal.policies.network import PolicyConfig
    from touchgoal.policies.perception.frozen_touch import TouchEmbedder
    from touchgoal.policies.sight.frozen_images import ImageInputConfig

# Sparsh (C.7). It leaves open how many ticks of a plan are done (here all 8), at what rate, and for
# how long to train (here the 600 epochs of diffusion_policy's real-robot tasks).
_PAPER = {
    "head": "published",
    "representation": "delta",
    "arm_state": "measured",
    "observation_horizon": 2,
    "touch_noise": 0.0,
    "position_noise": 0.0,
    "execution_horizon": 8,
    "train": TrainConfig(epochs=600, lr=1e-4, snapshot_epochs=100),
    "sampler": SamplerConfig("ddpm", num_train_timesteps=100, num_inference_steps=100),
}
# Fifty demonstrations of a task of one's own, by cameras and touch.
_SIGHT = {
    "cameras": ("front", "wrist"),
    "arm_state": "measured",
    "observation_horizon": 2,
    "touch_noise": 1.0,
    "trim_pauses": True,
    "action_share": 0.98,
    "execution_horizon": 6,
    "train": TrainConfig(epochs=10, batch_size=64, lr=3e-3, snapshot_epochs=5),
    "sampler": SamplerConfig(loss="absolute"),
}
_END_TO_END = Path("end-to-end")
_PROJECTION_DIM = {"default": 64, "sight": 64, "paper": 256}  # width of the touch projection


@checked_dataclass
class TrialOptions:
    """Options of the task in which snapshots are tried, in place of the task's defaults."""

    as_deployed: bool = False
    """Simulate the delays, limits and measurement errors of an arm driven by `deploy`."""
    sensor: str = ""
    """Folder of your own sensor file; default: the sensor that the episodes were recorded with."""
    start_angle: float | None = None
    """Bead maze: largest angle between hand and wire at the start, degrees."""
    max_seconds: Positive | None = None
    """Time limit of an episode, s."""


@checked_dataclass
class Config(TrainingOptions):
    """Options of train-policy."""

    PRESETS: ClassVar = {"paper": _PAPER, "sight": _SIGHT}

    data: Path
    """Episode set to train on: successful ones, and those in which an expert corrected a policy. A pattern
    in quotes, such as 'runs/large/*', opens many sets as one."""
    validation: Path
    """Episode set for the validation loss; it must share no recording with --data."""
    preset: Literal["default", "sight", "paper"] = "default"
    """Default hyperparameters: for two CPU cores; for some fifty recordings with cameras front and
    wrist; or as published for the bead maze (Sparsh C.7, diffusion_policy): U-Net of 87 M, 100 DDPM
    steps, joint changes, 600 epochs, days on a CPU."""
    actions: Annotated[ActionMeaning, RARE] = "change"
    """Meaning of the recorded actions: change (joint change per tick, as touchgoal records), absolute
    (joint positions) or relative (joint change since the episode's start)."""
    include_unknown: Annotated[bool, RARE] = False
    """Also train on episodes that do not say whether they succeeded."""
    judged: bool = False
    """Train on the episodes that a judge or a person accepted (touchgoal judge), whatever outcome was
    recorded; those judged failure or unsure are left out."""
    trim_pauses: bool = False
    """Leave out the frames of each episode before arm or gripper first move."""
    task: str | None = None
    """Task of the episodes; default: the one they name. Snapshots are tried in a simulated task; of any
    other, which is known by its recordings alone, the last one is taken."""
    encoder: Path | None = None
    """Frozen touch encoder: a folder (train-encoder), or the name of a shipped one; or end-to-end, a touch
    ViT that is trained with the policy. Default: none."""
    cameras: tuple[str, ...] = ()
    """Cameras that the policy reads at every plan, such as front wrist; default: none. A frozen image
    encoder's feature maps tell it the next key pose: where the hand will be when the gripper next
    opens or closes. A camera with wrist or hand in its name moves with the hand."""
    hand_force: bool = False
    """The policy also reads the force and torque on the hand; not with body_twist."""
    estimator: Path | None = None
    """Folder of a pose estimator (train-pose-estimator). The policy is trained on the simulator's
    contacts and object poses, without images; when it acts, contact comes from touch and the poses
    from the estimator."""
    out: Path | None = None
    """Folder of the run; the policy goes to its `policy/`."""
    share: Annotated[Fraction, RARE] = 1.0
    """Share of the episodes to train on, counted from the first."""
    head: Head = "mlp"
    """Denoiser of a diffusion policy: a multilayer perceptron (mlp) or a U-Net (published, tiny), which trains
    longer; or regression, which predicts plans directly."""
    representation: ActionRepresentation = "body_twist"
    """Actions as the network predicts them: delta (joint change of each control tick), relative
    (joint change since the plan's start), absolute (joint positions), base_twist or body_twist
    (displacement and rotation of the hand along the base's or the hand's axes). body_twist also
    gives the network the hand's motion along its own axes; with --estimator take base_twist."""
    arm_state: ArmState | None = None
    """Arm state that the policy reads: measured, or commanded, which no delay affects. Default: commanded
    if the episodes have it, as observation.command."""
    refuse_unknown_touch: bool = False
    """The policy stops once touch has been unlike all of the training for a second. For episodes in
    which an expert corrected a policy (make-policy): a limit from demonstrations alone also stops
    good runs."""
    touch_noise: Annotated[NotNegative, RARE] = 0.1
    """Noise on touch embeddings in training, relative to their standard deviation."""
    position_noise: Annotated[NotNegative, RARE] = 0.3
    """Noise on joint and hand positions in training, where the policy reads them, relative to their
    standard deviation."""
    action_share: Annotated[Fraction, RARE] = 1.0
    """Middle share of the actions that the network's range of -1 to 1 covers; below 1, rare large
    motions do not make all others tiny."""
    observation_horizon: Annotated[Count, RARE] = 4
    """Control ticks that the policy observes, the latest included."""
    execution_horizon: Count = 2
    """Control ticks of a plan that are executed before the next plan."""
    train: TrainConfig = TrainConfig()
    """Epochs, learning rate, batches."""
    sampler: Annotated[SamplerConfig, RARE] = SamplerConfig("ddim", 5, 1, "absolute")
    """Noise schedule and denoising of a diffusion policy."""
    trials: CountOrNone = 24
    """Number of validation episodes in which every snapshot is tried; 0 takes the last snapshot."""
    env: TrialOptions = TrialOptions()
    """Options of the task in which snapshots are tried."""
    workers: Count = os.cpu_count() or 1
    """Processes that simulate."""
    ray: str | None = None
    """Address of a Ray cluster whose cores work in place of --workers; auto: one started on this machine."""


def main(config: Config) -> None:
    """Embed touch, train, choose a snapshot."""
    from touchgoal.encoders.pretrained import find_encoder
    from touchgoal.encoders.training.run import check_run, open_sets, open_training, recipe
    from touchgoal.encoders.training.trainer import is_first_process
    from touchgoal.episodes.keys import parse_keys
    from touchgoal.policies.checkpoint import ESTIMATOR, POLICY_FORMAT, TOUCH
    from touchgoal.policies.perception.frozen_touch import load_touch
    from touchgoal.policies.perception.state_estimation import load_pose_estimator
    from touchgoal.policies.training import sequence_dataset, training_data
    from touchgoal.policies.training.model_selection import copy_parts, score, select
    from touchgoal.policies.training.train import POLICY, train
    from touchgoal.runtime.json_file import write_json

    check_run(config, config.out)
    if config.cameras and config.estimator:
        raise UserError("--cameras and --estimator exclude each other: leave out one")
    frozen = None if config.encoder == _END_TO_END else config.encoder
    touch = load_touch(frozen) if frozen else None
    parts = {TOUCH: find_encoder(frozen, published=False)} if frozen else {}
    if config.estimator:
        load_pose_estimator(config.estimator)
        parts[ESTIMATOR] = config.estimator
    sets = open_sets(config.data, config.validation, parse_keys(config.keys))
    unknown = config.include_unknown
    first = (
        training_data.choose_judged(sets[0])
        if config.judged
        else training_data.choose_episodes(sets[0], unknown)
    )
    found = [first, training_data.choose_episodes(sets[1], unknown)]
    rows = [f.rows for f in found]
    rows[0] = rows[0][: max(1, round(config.share * len(rows[0])))]
    chosen = list(zip(sets, rows, strict=True))
    task = training_data.find_task(chosen, config.task)
    simulated = cast(TaskName, task) if task in TASKS else None
    trials = config.trials if simulated else 0
    sensor = training_data.common_fact("sensor", chosen) if config.encoder else ""
    env = _env(config.env, simulated, sensor) if simulated else None
    policy = replace(_policy_config(config, sets[0], touch), task=task, sensor=sensor)
    for one in sets:
        sequence_dataset.check_arm(one)
    meant = [check_actions(*one, config.actions) for one in chosen]
    pauses = [training_data.find_pauses(*one, config.actions) for one in chosen]
    out = open_training(config, "train-policy")
    print(f"{task}: {found[0]} for training, {found[1]} for validation")
    print(meant[0])
    if not simulated:
        print(f"no simulator knows {task!r}: snapshots are not tried, the last one is taken")
    training_data.report_pauses(pauses[0], sets[0].fps, config.trim_pauses)
    skipped = pauses if config.trim_pauses else [None, None]
    workers = config.ray or config.workers
    about = policy, touch, workers
    recordings = (
        sequence_dataset.load_recordings(s, r, *about, skip, config.actions, config.judged)
        for (s, r), skip in zip(chosen, skipped, strict=True)
    )
    windows, validation = (sequence_dataset.SequenceDataset(r, policy) for r in recordings)
    print(f"{len(windows)} windows of {len(rows[0])} episodes; {len(validation)} for validation")
    provenance = recipe(*sets) | {"episodes": len(rows[0])}
    train(policy, windows, validation, config.train, out, config, provenance)
    if not is_first_process():
        return
    copy_parts(out / POLICY, parts)
    if env is not None and trials:
        scores = select(out, parts, lambda d: score(d, env, trials, workers))
        write_json(out / "metrics.json", {"snapshots": scores})
    ended, of = POLICY_FORMAT.provenance(out / POLICY)["ended"]
    print(f"policy: {out / POLICY}; it notices {ended} of {of} ends in validation")
    if simulated:
        print(f"next: touchgoal run-policy --task {task} --policy {out / POLICY}")
    else:
        print(f"next: touchgoal deploy CELL --policy {out / POLICY}")


def _policy_config(
    config: Config, episodes: "EpisodeSet", touch: "TouchEmbedder | None"
) -> "PolicyConfig":
    from touchgoal.policies.heads.diffusion import DiffusionConfig
    from touchgoal.policies.heads.mlp import MLPConfig
    from touchgoal.policies.heads.unet import PRESETS
    from touchgoal.policies.network import PolicyConfig
    from touchgoal.policies.perception.end_to_end import EndToEndConfig
    from touchgoal.policies.perception.state_estimation import ESTIMATED

    usual = "commanded" if ft.COMMAND in episodes.features else "measured"
    commanded = (config.arm_state or usual) == "commanded"
    columns = ft.STATE, ft.TCP_POSE, *[ft.COMMAND] * commanded
    if config.hand_force or config.estimator:
        columns += (ft.WRENCH,)
    head = MLPConfig()
    if config.head != "regression":
        denoiser = MLPConfig() if config.head == "mlp" else PRESETS[config.head]
        predicts = "epsilon" if config.sampler.kind == "ddpm" else "sample"
        head = DiffusionConfig(denoiser, replace(config.sampler, prediction_type=predicts))
    return PolicyConfig(
        touch_dim=touch.dim if touch else 0,
        touch=touch.name if touch else "",
        touch_projection_dim=_PROJECTION_DIM[config.preset],
        watches_novelty=config.refuse_unknown_touch,
        says_end=True,
        touch_noise=config.touch_noise,
        position_noise=config.position_noise,
        end_to_end=EndToEndConfig() if config.encoder == _END_TO_END else None,
        images=_image_input(config, episodes),
        proprioception=(*columns, *ESTIMATED) if config.estimator else columns,
        representation=config.representation,
        observation_horizon=config.observation_horizon,
        execution_horizon=config.execution_horizon,
        action_share=config.action_share,
        control_hz=episodes.fps,
        head=head,
    )


def _image_input(config: Config, episodes: "EpisodeSet") -> "ImageInputConfig | None":
    from touchgoal.policies.sight.frozen_images import ImageInputConfig

    if not config.cameras:
        return None
    keys = tuple(ft.IMAGE_PREFIX + name.removeprefix(ft.IMAGE_PREFIX) for name in config.cameras)
    images = [key for key in episodes.features if key.startswith(ft.IMAGE_PREFIX)]
    there = [key for key in images if key not in ft.TACTILE]
    if missing := set(keys) - set(there):
        raise UserError(
            f"{episodes.root} has no {sorted(missing)[0]}; its cameras: {', '.join(there) or 'none'}"
        )
    sizes = {tuple(episodes.features[key]["shape"][:2]) for key in keys}
    if len(sizes) > 1:
        raise UserError(
            f"the cameras' images have several sizes: {sorted(sizes)}; choose one camera"
        )
    height, width = sizes.pop()
    return ImageInputConfig(keys, (height, width))


def _env(options: TrialOptions, task: TaskName, sensor: str) -> TaskConfig:
    from touchgoal.control.tactile.sensor_models import find_sensor
    from touchgoal.sim_envs.config import ENVS

    env, given = ENVS[task], {name: value for name, value in vars(options).items() if value}
    if "start_angle" in given and not isinstance(env, BeadMazeConfig):
        raise UserError(f"--env.start-angle is for bead-maze, the episodes are of {task}")
    if options.sensor and sensor not in ("", find_sensor(options.sensor).name):
        raise UserError(f"--env.sensor: the episodes were recorded with {sensor}: leave it out")
    return replace(env, **{"sensor": sensor or env.sensor} | given)
