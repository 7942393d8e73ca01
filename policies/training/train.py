"""Training of a policy on recorded sequences (the recipe of Chi et al. 2023)."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from accelerate.utils import send_to_device
from jaxtyping import Int
from torch import Tensor
from torch.optim.swa_utils import AveragedModel

from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.encoders.training.checkpoint import checksum
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.encoders.training.trainer import OptimizerConfig, Training, fit, on_first_process
from touchgoal.policies import checkpoint
from touchgoal.policies.config import TrainConfig
from touchgoal.policies.network import PolicyConfig, PolicyNetwork
from touchgoal.policies.sight.key_pose import gripper_changes
from touchgoal.policies.training.end import fit_end
from touchgoal.policies.training.sequence_dataset import SequenceDataset

POLICY, SNAPSHOTS = "policy", "snapshots"  # folders of a run
BETAS, WEIGHT_DECAY = (0.95, 0.999), 1e-6  # of AdamW, as in diffusion_policy
_WARMUP_STEPS = 500  # as there; a tenth of a training that is shorter
_VALIDATION_WINDOWS = 1024  # evenly spaced, for the losses


def train(
    policy: PolicyConfig,
    windows: SequenceDataset,
    validation: SequenceDataset,
    config: TrainConfig,
    out_dir: Path,
    options: TrainerOptions,
    recipe: dict[str, Any],
) -> PolicyNetwork:
    """Train a policy; the moving average of its weights is the result.

    Beside the files of `trainer.fit` it writes snapshots to `snapshots/epoch-<n>/`, and the last
    one to `policy/`. A run that is killed and resumed ends with the same weights as an
    uninterrupted one. Returns the policy as saved in `out_dir/policy`. UserError: no such device,
    or a folder that does not fit `options.resume`.

    Args:
        validation: windows of other episodes.
        out_dir: folder of a new run, or of the one to resume.
        recipe: JSON-able provenance of the episodes, written beside the weights.
    """
    network = untrained(policy, windows, options.seed)
    average = AveragedModel(network, multi_avg_fn=_update_average).eval().requires_grad_(False)
    averaged = cast(PolicyNetwork, average.module)

    def save_snapshot(history: list[dict[str, float]], provenance: dict[str, Any]) -> None:
        known = {"train": asdict(config), "windows": len(windows), "metrics": history[-1]}
        last = len(history) == config.epochs
        folders = [out_dir / POLICY] if last else []
        if last or len(history) % config.snapshot_epochs == 0:
            folders.append(out_dir / SNAPSHOTS / f"epoch-{len(history):04d}")
        if folders and averaged.key_pose:
            batch = _validation_batch(averaged, validation)
            averaged.key_pose.calibrate(*averaged.seen(batch["observed"]), batch["key_pose"][:, 1:])
        if folders and averaged.end:  # how many validation episodes it ends, of how many
            known["ended"] = fit_end(averaged, windows, validation, options.seed)
        for folder in folders:
            on_first_process(partial(checkpoint.save, averaged, folder, provenance | known))

    training = Training(
        loss=network,
        n_samples=len(windows),
        batch=lambda rows, noise: make_batch(windows, windows.draw(rows, noise)) | {"noise": noise},
        optimizer=OptimizerConfig(
            config.epochs,
            config.batch_size,
            config.lr,
            WEIGHT_DECAY,
            betas=BETAS,
            max_warmup_steps=_WARMUP_STEPS,
        ),
        identity={
            "train": asdict(config),
            "warmup_steps": _WARMUP_STEPS,
            "policy": asdict(network.config),
            "data": [_checksum(windows), _checksum(validation)],
        },
        evaluate=lambda: _validate(averaged, validation, options.seed),
        progress=_progress,
        after_step=lambda: average.update_parameters(network),
        after_epoch=save_snapshot,
        extra_state={"average": average},
    )
    fit(training, out_dir, options, recipe)
    return checkpoint.load(out_dir / POLICY)


def untrained(policy: PolicyConfig, windows: SequenceDataset, seed: int) -> PolicyNetwork:
    """Return a network with random weights, its normalizers and gripper widths fitted to windows."""
    recorded = windows.recorded
    widths = recorded.actions[:, -1]
    if len(levels := widths.unique().tolist()) == 2:
        policy = replace(policy, gripper_widths=tuple(levels))
    if recorded.key_pose is not None:
        each = widths.split(list(recorded.lengths))
        policy = replace(policy, gripper_changes=min(len(gripper_changes(w.numpy())) for w in each))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = PolicyNetwork(policy)
    network.fit_normalizers(
        recorded.touch.float(), recorded.state, windows.joints, windows.actions,
        windows.action_is_pad, recorded.maps, recorded.key_pose,
    )  # fmt: skip
    network.fit_novelty(recorded.touch.float(), recorded.lengths)
    return network


def ema_decay(step: int) -> float:
    """Return the decay after `step` updates, by diffusion_policy's schedule and constants."""
    return min(0.9999, 1 - (1 + step) ** -0.75)


@torch.no_grad()
def _update_average(average: Sequence[Tensor], weights: Sequence[Tensor], n_averaged: Any) -> None:
    for mean, weight in zip(average, weights, strict=True):
        mean.lerp_(weight, 1 - ema_decay(int(n_averaged)))


def make_batch(windows: SequenceDataset, rows: Int[Tensor, " b"]) -> dict[str, Any]:
    """Return some windows as a `PolicyNetwork` takes them in training, but for the noise."""
    observed, actions = windows.take(rows)
    return {
        "observed": observed,
        "actions": actions,
        "action_is_pad": windows.action_is_pad[rows],
        "key_pose": windows.key_pose(rows),
    }


def _validation_batch(policy: PolicyNetwork, windows: SequenceDataset) -> dict[str, Any]:
    """Return windows from all over the validation episodes, on the policy's device."""
    n = min(_VALIDATION_WINDOWS, len(windows))
    rows = torch.linspace(0, len(windows) - 1, n).long()
    device = policy.action_normalizer.scale.device
    return cast(dict[str, Any], send_to_device(make_batch(windows, rows), device))


@torch.no_grad()
def _validate(policy: PolicyNetwork, windows: SequenceDataset, seed: int) -> dict[str, float]:
    """Return the loss, the error of the joint change (rad) planned over the chunk, and of key poses (m)."""
    batch = _validation_batch(policy, windows)
    generator = torch.Generator().manual_seed(seed)
    observed = batch["observed"]
    planned = policy.plan(observed, generator, key_pose=batch["key_pose"]).actions
    is_pad = batch["action_is_pad"]
    off = (planned - batch["actions"])[..., :7].masked_fill(is_pad[..., None], 0.0)
    error = off.sum(1).norm(dim=1).mean()
    loss = policy(**batch, noise=BatchNoise(generator))["loss"]
    metrics = {"validation_loss": loss.item(), "validation_error": error.item()}
    if policy.key_pose:
        off = policy.key_pose.error(*policy.seen(observed), batch["key_pose"][:, 1:])
        metrics["validation_key_pose_error"] = off[:, 0].median().item()
    return metrics


def _checksum(windows: SequenceDataset) -> str:
    recorded = windows.recorded
    return checksum(
        recorded.touch, recorded.state, recorded.actions, recorded.images,
        recorded.maps, recorded.key_pose, recorded.done, map(str, recorded.lengths), windows.weights,
    )  # fmt: skip


def _progress(metrics: dict[str, float]) -> str:
    text = (
        f"loss {metrics['loss']:.4f} in training, {metrics['validation_loss']:.4f} in validation; "
        f"planned joint change off by {1000 * metrics['validation_error']:.2f} mrad"
    )
    if "validation_key_pose_error" in metrics:
        text += f", next key pose by {1000 * metrics['validation_key_pose_error']:.0f} mm"
    return text
