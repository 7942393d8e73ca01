"""What `touchgoal train-policy` does."""

from dataclasses import replace
from pathlib import Path

from touchgoal.control import features as ft
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.encoders.pretrained import find_encoder
from touchgoal.encoders.training.run import (
    check_training,
    open_sets,
    open_training,
    recipe,
)
from touchgoal.encoders.training.trainer import is_first_process
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch.train_policy import ENVS, Config
from touchgoal.policies import checkpoint
from touchgoal.policies.checkpoint import SavedPolicy
from touchgoal.policies.evaluation.evaluate import Evaluation, run_trials, trial_specs
from touchgoal.policies.heads.diffusion import DiffusionConfig, RegressionConfig
from touchgoal.policies.heads.unet import PRESETS
from touchgoal.policies.network import PolicyConfig
from touchgoal.policies.perception.end_to_end import EndToEndConfig
from touchgoal.policies.perception.frozen_touch import TouchEmbedder, load_touch
from touchgoal.policies.perception.state_estimation import ESTIMATED, load_estimator
from touchgoal.policies.training.model_selection import Score, add_parts, select
from touchgoal.policies.training.sequence_dataset import SequenceDataset, load_recordings
from touchgoal.policies.training.train import POLICY, train
from touchgoal.policies.training.training_data import (
    check_apart,
    choose_episodes,
    common_sensor,
    common_task,
)
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.run_folder import write_json
from touchgoal.sim_envs.config import TASKS, TaskConfig, TaskName
from touchgoal.sim_envs.tasks import task_name


def run_command(config: Config) -> None:
    """Embed, train, choose."""
    check_training(config.trainer, config.out)
    if config.end_to_end and config.encoder:
        raise UserError("end-to-end touch takes no frozen encoder: leave it out")
    parts = {
        name: folder
        for name, folder in (
            (checkpoint.TOUCH, config.encoder and find_encoder(config.encoder, published=False)),
            (checkpoint.ESTIMATOR, config.estimator),
        )
        if folder
    }
    if config.estimator:
        load_estimator(config.estimator)
    touch = load_touch(config.encoder) if config.encoder else None
    sets = open_sets(config.data, config.validation)
    found = [choose_episodes(s, config.include_unknown) for s in sets]
    chosen = [f.rows for f in found]
    chosen[0] = chosen[0][: max(1, round(config.share * len(chosen[0])))]
    task = _task(config, list(zip(sets, chosen, strict=True)))
    feels = config.encoder or config.end_to_end or config.estimator
    check_apart(*zip(sets, chosen, strict=True))
    sensor = common_sensor(list(zip(sets, chosen, strict=True))) if feels else ""
    if config.trials:
        _check_sensor(config, task, sensor)
    policy = replace(_policy_config(config, sets[0], touch), task=task, sensor=sensor)
    out = open_training(config, "train-policy")
    print(f"{task}: {found[0]} to learn from, {found[1]} for validation")
    windows, validation = (
        SequenceDataset(load_recordings(s, rows, policy, touch, config.workers), policy)
        for s, rows in zip(sets, chosen, strict=True)
    )
    print(f"{len(windows)} windows of {len(chosen[0])} episodes; {len(validation)} for validation")
    provenance = recipe(*sets) | {"episodes": len(chosen[0])}
    train(policy, windows, validation, config.train, out, config.trainer, provenance)
    if not is_first_process():
        return
    add_parts(out / POLICY, parts)
    if config.trials:
        scores = select(out, parts, lambda directory: _try(config, task, directory))
        write_json(out / "metrics.json", {"snapshots": scores})
    print(f"policy: {out / POLICY}")


def _policy_config(
    config: Config, episodes: EpisodeSet, touch: TouchEmbedder | None
) -> PolicyConfig:
    head = RegressionConfig()
    if config.head != "regression":
        head = DiffusionConfig(PRESETS[config.head], config.sampler)
    return PolicyConfig(
        touch_dim=touch.dim if touch else 0,
        touch=touch.name if touch else "",
        touch_input=config.touch_input,
        touch_projection_dim=config.touch_projection_dim,
        touch_noise=config.touch_noise,
        position_noise=config.position_noise,
        end_to_end=EndToEndConfig() if config.end_to_end else None,
        proprioception=_columns(config),
        representation=config.representation,
        observation_horizon=config.observation_horizon,
        execution_horizon=config.execution_horizon,
        control_hz=episodes.fps,
        head=head,
    )


def _columns(config: Config) -> tuple[str, ...]:
    """Of the episodes, that the policy sees."""
    arm = (ft.STATE, ft.TCP_POSE) + (ft.COMMAND,) * (config.arm_state == "commanded")
    return arm + (ft.WRENCH, *ESTIMATED) if config.estimator else arm


def _task(config: Config, chosen: list[tuple[EpisodeSet, list[int]]]) -> TaskName:
    """What the data say; UserError if they are of several tasks, or of another than was asked for."""
    found = common_task(chosen)
    if config.task and found not in ("", config.task):
        raise UserError(f"{config.data} is of {found}, not of {config.task}: leave out --task")
    task = config.task or found
    if task not in TASKS:
        raise UserError(f"{config.data} does not say its task: add --task {' or '.join(TASKS)}")
    return task  # pyright: ignore[reportReturnType]


def _env(config: Config, task: TaskName) -> TaskConfig:
    """Options of the task in which snapshots are tried."""
    if task_name(config.env) == task:
        return config.env
    if config.env not in ENVS.values():
        raise UserError(f"the episodes are of {task}: add --task {task}, whose options --env.* are")
    return ENVS[task]


def _check_sensor(config: Config, task: TaskName, sensor: str) -> None:
    """UserError if snapshots would be tried with another sensor than the episodes'."""
    tried = find_sensor(_env(config, task).sensor).name
    if sensor and tried != sensor:
        raise UserError(
            f"{config.data} was recorded with {sensor}, snapshots would be tried with {tried}: add "
            f"--env.sensor {sensor}"
        )


def _try(config: Config, task: TaskName, directory: Path) -> Score:
    env = _env(config, task)
    policy = SavedPolicy(directory)
    env = policy.env_config(env)
    specs = trial_specs(env, config.trials, seeds.MODEL_SELECTION.start)
    result = Evaluation(tuple(run_trials(env, policy, specs, config.workers)))
    return result.rate.successes / result.rate.trials, result.progress
