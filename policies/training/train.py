"""Training a policy on recorded windows (the recipe of Chi et al. 2023)."""

import copy
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from touchgoal.control.errors import UserError
from touchgoal.encoders.training import checkpoint as resumable
from touchgoal.policies import checkpoint
from touchgoal.policies.policy import ObservationBatch, Policy, PolicyConfig
from touchgoal.policies.training import ema
from touchgoal.policies.training.sequence_dataset import SequenceDataset

POLICY, SNAPSHOTS = "policy", "snapshots"


@dataclass(frozen=True)
class TrainConfig:
    """How to train a policy.

    Attributes:
        epochs: passes over the windows.
        batch_size: windows a step; all of them if there are fewer.
        lr: highest learning rate, of AdamW; reached from 0, left by a cosine to 0.
        betas: of AdamW.
        weight_decay: of AdamW.
        warmup: steps in which the rate rises; a tenth of the training if that is shorter.
        snapshot_epochs: a policy is kept for trial every so many epochs, and the last one.
        validation_windows: on which losses are measured, evenly spaced.
        device: of the training.
        seed: of everything random.
    """

    epochs: int = 60
    batch_size: int = 256
    lr: float = 5e-4
    betas: tuple[float, float] = (0.95, 0.999)
    weight_decay: float = 1e-6
    warmup: int = 500
    snapshot_epochs: int = 10
    validation_windows: int = 1024
    device: str = "cpu"
    seed: int = 0


def train(
    policy: PolicyConfig,
    windows: SequenceDataset,
    validation: SequenceDataset,
    config: TrainConfig,
    out_dir: Path,
    recipe: dict[str, Any],
    resume: bool = False,
) -> Policy:
    """Trains a policy; its weights' average is what is kept.

    Writes `metrics.jsonl` (a line an epoch), `checkpoint.pt` (after every epoch), a policy to
    `snapshots/epoch-<n>/` every so often and at the end, and the last one to `policy/`. Which
    snapshot acts best, only closed-loop trials can tell. Killed and resumed, it ends with the same weights as
    uninterrupted.

    Args:
        policy: what to train.
        windows: to learn from.
        validation: of other episodes.
        config: how to train.
        out_dir: a new run's directory, or with `resume` the one to go on with.
        recipe: JSON-able; where the episodes come from, kept with the weights.
        resume: go on after the last finished epoch.

    Returns:
        The policy as saved in `out_dir/policy`.

    Raises:
        UserError: no such device, or a directory that does not fit `resume`.
    """
    resumable.check(out_dir, resume, config.device)
    if config.epochs < 1 or config.batch_size < 1 or config.snapshot_epochs < 1:
        raise UserError("training needs epochs, batch_size and snapshot_epochs of at least 1")
    run = _Run(policy, windows, config)
    if resume:
        run.restore(out_dir)
    out_dir.mkdir(parents=True, exist_ok=True)
    for epoch in range(len(run.history), config.epochs):
        losses = {"epoch": epoch + 1, "loss": run.train_epoch(epoch)}
        run.history.append(losses | run.validate(validation))
        provenance = {
            **recipe,
            "train": asdict(config),
            "windows": len(windows),
            "metrics": run.history[-1],
        }
        if (epoch + 1) % config.snapshot_epochs == 0 or epoch + 1 == config.epochs:
            checkpoint.save(run.average, out_dir / SNAPSHOTS / f"epoch-{epoch + 1:04d}", provenance)
        if epoch + 1 == config.epochs:
            checkpoint.save(run.average, out_dir / POLICY, provenance)
        run.checkpoint(out_dir)
        tqdm.write(_progress_line(run.history[-1], config.epochs))
    return checkpoint.load(out_dir / POLICY)


class _Run:
    """State of a training that survives a kill."""

    def __init__(self, policy: PolicyConfig, windows: SequenceDataset, config: TrainConfig) -> None:
        self.config, self.windows = config, windows
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.policy = Policy(policy)
        touch, state = windows.recorded.touch.float(), windows.recorded.state
        wrench = windows.recorded.wrench
        self.policy.fit_normalizers(
            touch, state, windows.joints, windows.actions, wrench, windows.action_is_pad
        )
        self.policy.to(config.device)
        self.average = copy.deepcopy(self.policy).eval().requires_grad_(False)
        self.optimiser = torch.optim.AdamW(
            self.policy.parameters(), config.lr, config.betas, weight_decay=config.weight_decay
        )
        self.history: list[dict[str, float]] = []
        self.batch_size = min(config.batch_size, len(windows))
        self.steps = len(windows) // self.batch_size

    def train_epoch(self, epoch: int) -> float:
        """One pass, its mean loss."""
        count, size = len(self.windows), self.batch_size
        generator, batches = resumable.shuffle(count, size, self.config.seed, epoch)
        self.policy.train()
        total = 0.0
        progress = tqdm(batches, desc=f"epoch {epoch + 1}/{self.config.epochs}", leave=False)
        for i, rows in enumerate(progress):
            step = epoch * self.steps + i
            for group in self.optimiser.param_groups:
                group["lr"] = _learning_rate(self.config, step, self.config.epochs * self.steps)
            loss = self._loss(self.policy, self.windows, rows, generator)
            self.optimiser.zero_grad()
            loss.backward()
            self.optimiser.step()
            ema.update(self.average, self.policy, step)
            total += loss.item()
            progress.set_postfix(loss=f"{loss.item():.4f}")
        return total / self.steps

    @torch.no_grad()
    def validate(self, windows: SequenceDataset) -> dict[str, float]:
        """The average's loss, and the error of the joint change (rad) it plans over the chunk."""
        n = min(self.config.validation_windows, len(windows))
        rows = torch.linspace(0, len(windows) - 1, n).long()
        batch, actions = self._take(windows, rows)
        generator = torch.Generator().manual_seed(self.config.seed)
        planned = self.average.plan(batch, generator)
        off = (planned - actions)[..., :7]
        off = off.masked_fill(windows.action_is_pad[rows, :, None].to(off.device), 0.0)
        error = off.sum(1).norm(dim=1).mean()
        loss = self._loss(self.average, windows, rows, generator)
        return {"validation_loss": loss.item(), "validation_error": error.item()}

    def checkpoint(self, out_dir: Path) -> None:
        """Writes everything needed to go on."""
        state = {
            "policy": self.policy.state_dict(),
            "average": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }
        resumable.save(out_dir, self._setting(), state, self.history)

    def restore(self, out_dir: Path) -> None:
        """Reads a checkpoint; UserError if it is of another training."""
        state = resumable.restore(out_dir, self._setting(), self.config.device)
        self.policy.load_state_dict(state["policy"])
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.history = state["history"]

    def _loss(
        self,
        policy: Policy,
        windows: SequenceDataset,
        rows: torch.Tensor,
        generator: torch.Generator,
    ) -> torch.Tensor:
        wrench = windows.wrench(rows)
        wrench = None if wrench is None else wrench.to(self.config.device)
        is_pad = windows.action_is_pad[rows].to(self.config.device)
        return policy.loss(*self._take(windows, rows), generator, wrench, is_pad)

    def _take(
        self, windows: SequenceDataset, rows: torch.Tensor
    ) -> tuple[ObservationBatch, torch.Tensor]:
        batch, actions = windows.take(rows)
        device = self.config.device
        pictures = None if batch.pictures is None else batch.pictures.to(device)
        seen = ObservationBatch(batch.touch.to(device), batch.state.to(device), pictures)
        return seen, actions.to(device)

    def _setting(self) -> str:
        recorded = self.windows.recorded
        data = recorded.lengths, recorded.checksum
        return json.dumps((asdict(self.config), asdict(self.policy.config), data))


def _learning_rate(config: TrainConfig, step: int, steps: int) -> float:
    warmup = min(config.warmup, steps // 10)
    return config.lr * resumable.warmed_cosine(step, steps, warmup)


def _progress_line(metrics: dict[str, float], epochs: int) -> str:
    return (
        f"epoch {metrics['epoch']}/{epochs}  loss {metrics['loss']:.4f}  "
        f"validation {metrics['validation_loss']:.4f}, "
        f"plan off by {1000 * metrics['validation_error']:.2f} mrad"
    )
