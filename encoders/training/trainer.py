"""The one loop by which all networks here are trained, on Accelerate.

An epoch's randomness depends on the seed and the epoch alone, so a resumed training ends with the
same weights, bit for bit. Several processes share each batch and its noise.
"""

import atexit
import gc
import math
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from accelerate import Accelerator
from accelerate.utils import send_to_device
from jaxtyping import Int, Shaped
from torch import Tensor, nn
from tqdm import tqdm

from touchgoal.encoders.training import checkpoint
from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.interruption import on_interruption
from touchgoal.runtime.provenance import command_line

Metrics = dict[str, Any]  # numbers by name; None where one is undefined


@dataclass(frozen=True)
class OptimizerConfig:
    """Settings of Adam and its schedules."""

    epochs: int  # passes over the data
    # samples per step over all processes; all of them if there are fewer. Samples that fill no batch
    # are left out of their epoch
    batch_size: int
    lr: float  # highest learning rate
    weight_decay: float  # of weight matrices and convolutions; not biases, norms and tokens
    betas: tuple[float, float] = (0.9, 0.999)  # Adam's betas
    # AdamW (Loshchilov and Hutter 2019); otherwise Adam, with an L2 term in the gradient
    decoupled_weight_decay: bool = True
    warmup: float = 0.1  # share of the steps in which the rate rises linearly from 0
    max_warmup_steps: float = math.inf  # upper bound of these steps
    final_lr: float = 0.0  # last rate over `lr`, reached by a cosine; 1 keeps it constant
    max_grad_norm: float | None = None  # gradients are clipped to this norm; None: no clipping
    # weight decay at the end, reached by a cosine; None: constant
    final_weight_decay: float | None = None

    def build(self, module: nn.Module) -> torch.optim.Optimizer:
        """Return the optimizer of a module's parameters."""
        kind = torch.optim.AdamW if self.decoupled_weight_decay else torch.optim.Adam
        return kind(parameter_groups(module, self.weight_decay), lr=self.lr, betas=self.betas)

    def learning_rate(self, step: int, steps: int) -> float:
        """Return the rate of a step, counted from 0, of `steps`."""
        warmup = min(self.max_warmup_steps, int(self.warmup * steps))
        if step < warmup:
            return self.lr * (step + 1) / (warmup + 1)
        cosine = (1 + math.cos(math.pi * (step - warmup) / max(steps - warmup, 1))) / 2
        return self.lr * (self.final_lr + (1 - self.final_lr) * cosine)

    def decay(self, step: int, steps: int) -> float:
        """Return the weight decay of a step, counted from 0, of `steps`."""
        if self.final_weight_decay is None:
            return self.weight_decay
        share = (1 - math.cos(math.pi * step / steps)) / 2
        return self.weight_decay + share * (self.final_weight_decay - self.weight_decay)

    def steps(self, n_samples: int) -> int:
        """Return the number of updates of a training with `n_samples` per epoch."""
        return self.epochs * (n_samples // min(self.batch_size, n_samples))


def parameter_groups(module: nn.Module, weight_decay: float) -> list[dict[str, Any]]:
    """Return the weights of linear layers and convolutions, which decay, then all other parameters."""
    decayed, others = [], []
    for name, parameter in module.named_parameters():
        if not parameter.requires_grad:
            continue
        matrix = name.endswith("weight") and parameter.ndim > 1
        (decayed if matrix else others).append(parameter)
    return [
        {"params": decayed, "weight_decay": weight_decay},
        {"params": others, "weight_decay": 0.0},
    ]


@dataclass(eq=False)
class Training:
    """A training: its loss, its data and its callbacks."""

    # module called with a batch; returns named scalars, of which "loss" is minimised. Its
    # parameters that require a gradient are trained
    loss: nn.Module
    n_samples: int  # samples of an epoch
    # makes a batch of these samples on the CPU, one entry each; random only by the `BatchNoise`
    batch: Callable[[Int[Tensor, " b"], BatchNoise], dict[str, Any]]
    optimizer: OptimizerConfig  # settings of the optimizer
    identity: Mapping[str, Any]  # JSON-able: data and settings; a run resumes only with the same
    evaluate: Callable[[], Metrics] = dict  # after every epoch: metrics to record beside the losses
    progress: Callable[[Metrics], str] = str  # returns the line to print for an epoch's metrics
    after_step: Callable[[], object] = lambda: None  # called after every update of the weights
    # called with all metrics so far and the provenance before the checkpoint is written; in every
    # process, see `on_first_process`
    after_epoch: Callable[[list[Metrics], dict[str, Any]], object] = lambda *_: None
    # further objects with `state_dict` and `load_state_dict` for the checkpoint
    extra_state: dict[str, Any] = field(default_factory=dict)


def fit(
    training: Training, out_dir: Path, options: TrainerOptions, recipe: Mapping[str, Any]
) -> tuple[list[Metrics], dict[str, Any]]:
    """Train; after Ctrl-C the finished epochs can be resumed.

    Writes `metrics.jsonl` (one line per epoch), curves for the trackers and `checkpoint.pt` (after
    every epoch). Returns the metrics of every epoch, and the provenance to store beside the
    weights. UserError: no such device, or a folder that does not fit `options.resume`.

    Args:
        training: What to train; its modules are moved to the device, and changed.
        out_dir: A new run's folder, or with `options.resume` the one to resume.
        recipe: JSON-able provenance: command, commit, data and their checksum.
    """
    checkpoint.check_run_folder(out_dir, options.resume)
    accelerator = _accelerator(options.device)
    config, size = training.optimizer, min(training.optimizer.batch_size, training.n_samples)
    if size % accelerator.num_processes:
        raise UserError(
            f"{accelerator.num_processes} processes cannot share batches of {size}: choose a batch size "
            "that is a multiple of their number"
        )
    for module in (training.loss, *training.extra_state.values()):
        if isinstance(module, nn.Module):
            module.to(accelerator.device)
    optimizer = config.build(training.loss)
    identity = {
        **training.identity,
        "n_samples": training.n_samples,
        "seed": options.seed,
        "precision": options.precision,
    }
    state = {"model": training.loss, "optimizer": optimizer, **training.extra_state}
    history: list[Metrics] = []
    provenance = {**recipe, "seed": options.seed, "precision": options.precision}
    if options.resume:
        history, provenance = checkpoint.load(out_dir, identity, state, provenance)
    record = None
    if accelerator.is_main_process:
        record = checkpoint.Record(out_dir, identity, provenance, options.log_with, options.device)
    model, optimizer = accelerator.prepare(training.loss, optimizer)
    try:
        with on_interruption(lambda: _how_to_resume(out_dir, len(history), config.epochs)):
            for epoch in range(len(history), config.epochs):
                losses = _train_epoch(training, accelerator, model, optimizer, options, epoch)
                training.loss.eval()
                history.append({"epoch": epoch + 1, **losses, **training.evaluate()})
                training.after_epoch(history, provenance)
                if record:
                    record.write(history, state)
                line = f"epoch {epoch + 1}/{config.epochs}  {training.progress(history[-1])}"
                on_first_process(partial(tqdm.write, line))
    finally:
        if record:
            record.close()
    training.loss.eval()
    return history, provenance


def _train_epoch(
    training: Training,
    accelerator: Accelerator,
    model: nn.Module,
    optimizer: torch.optim.Optimizer,
    options: TrainerOptions,
    epoch: int,
) -> Metrics:
    """Train one pass over the data; return the mean of each loss."""
    config = training.optimizer
    size = min(config.batch_size, training.n_samples)
    rank, world = accelerator.process_index, accelerator.num_processes
    generator, batches = epoch_batches(training.n_samples, size, options.seed, epoch)
    noise = BatchNoise(generator, rank, world)
    mixed = torch.autocast(
        accelerator.device.type, torch.bfloat16, enabled=options.precision == "bf16"
    )
    steps = config.steps(training.n_samples)
    model.train()
    losses: list[dict[str, Tensor]] = []
    name = f"epoch {epoch + 1}/{config.epochs}"
    for i, rows in enumerate(tqdm(batches, desc=name, leave=False, disable=rank > 0 or None)):
        step = epoch * len(batches) + i
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate(step, steps)
        optimizer.param_groups[0]["weight_decay"] = config.decay(step, steps)
        own = rows.chunk(world)[rank]
        batch = send_to_device(training.batch(own, noise), accelerator.device)
        with mixed:
            terms = model(**batch)
        optimizer.zero_grad()
        accelerator.backward(terms["loss"].float())
        if config.max_grad_norm is not None:
            accelerator.clip_grad_norm_(model.parameters(), config.max_grad_norm)
        optimizer.step()
        training.after_step()
        losses.append({name: term.detach() for name, term in terms.items()})
    return _mean_over_steps(losses, accelerator)


def _mean_over_steps(losses: list[dict[str, Tensor]], accelerator: Accelerator) -> Metrics:
    """Return the mean of each term over all steps (absent ones count 0) and processes."""
    means = {}
    for name in {name: None for terms in losses for name in terms}:
        values = torch.stack([terms[name].float() for terms in losses if name in terms])
        values = cast(Tensor, accelerator.reduce(values, "mean"))
        means[name] = sum(values.tolist()) / len(losses)
    return means


def _how_to_resume(out_dir: Path, done: int, epochs: int) -> str:
    if not done:
        return f"no epoch was finished, nothing is saved in {out_dir}"
    command = command_line()
    if "--out" not in command:
        command += f" --out {shlex.quote(str(out_dir))}"
    if "--resume" not in command:
        command += " --resume"
    return f"{done} of {epochs} epochs are saved in {out_dir}; resume with: {command}"


def epoch_batches(
    n_samples: int, batch_size: int, seed: int, epoch: int
) -> tuple[torch.Generator, tuple[Int[Tensor, " b"], ...]]:
    """Return an epoch's generator and its batches of rows; rows that fill no batch are left out."""
    generator = torch.Generator().manual_seed(seed * 1_000_003 + epoch)
    order = torch.randperm(n_samples, generator=generator)
    return generator, order[: n_samples // batch_size * batch_size].split(batch_size)


def gather_batch(rows: Shaped[Tensor, "b ..."]) -> Shaped[Tensor, "n ..."]:
    """Return the rows of all processes, in order and with gradients, for losses between samples."""
    return _AllRows.apply(rows.contiguous()) if torch.distributed.is_initialized() else rows


class _AllRows(torch.autograd.Function):
    """Gather rows; the functional collectives of torch 2.13 overwrite foreign memory over gloo."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor) -> Tensor:
        parts = [torch.empty_like(rows) for _ in range(torch.distributed.get_world_size())]
        torch.distributed.all_gather(parts, rows)
        return torch.cat(parts)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> Tensor:
        summed = grad_outputs[0].clone(memory_format=torch.contiguous_format)
        torch.distributed.all_reduce(summed)
        return own_rows(summed, len(summed) // torch.distributed.get_world_size())


def own_rows(rows: Shaped[Tensor, "n ..."], count: int) -> Shaped[Tensor, "{count} ..."]:
    """Return this process's rows of what `gather_batch` returned."""
    first = torch.distributed.get_rank() * count if torch.distributed.is_initialized() else 0
    return rows[first : first + count]


def on_first_process(action: Callable[[], object]) -> None:
    """Run `action` in the first of several processes, while the others wait."""
    if is_first_process():
        action()
    if torch.distributed.is_initialized():  # Accelerate's own wait wants a GPU for each process
        torch.distributed.barrier()


def is_first_process() -> bool:
    """Return whether this is the only process, or the first of several."""
    return not torch.distributed.is_initialized() or torch.distributed.get_rank() == 0


def check_device(device: str) -> None:
    """Raise UserError if this machine has no such device."""
    kind, _, index = device.partition(":")
    if kind not in ("cpu", "cuda", "mps") or (index and not (kind == "cuda" and index.isdigit())):
        raise UserError(f"unknown device '{device}': choose cpu, cuda, cuda:<number> or mps")
    if kind == "cuda" and int(index or 0) >= torch.cuda.device_count():
        raise UserError(f"there is no device {device} here: choose the device cpu")
    if kind == "mps" and not torch.backends.mps.is_available():
        raise UserError("there is no device mps here: choose the device cpu")


def _accelerator(device: str) -> Accelerator:
    """Return an Accelerator without mixed precision, which it fixes per process; we autocast."""
    check_device(device)
    kind, _, index = device.partition(":")
    if index:
        torch.cuda.set_device(int(index))
    try:
        accelerator = Accelerator(cpu=kind == "cpu", mixed_precision="no")
    except ValueError:  # Accelerate's state in this process is of a GPU
        accelerator = Accelerator(mixed_precision="no")
    if accelerator.device.type != kind:
        raise UserError(
            f"this process has trained on {accelerator.device.type} already: train on {device} in a new one"
        )
    if accelerator.num_processes > 1:
        atexit.unregister(_leave_process_group)  # of an earlier training in this process
        atexit.register(_leave_process_group)
    return accelerator


def _leave_process_group() -> None:
    """Free the wrapped models, then end gloo's threads: left to the exit, they may crash (torch 2.13)."""
    gc.collect()
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()
