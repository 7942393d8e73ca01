"""Trainings that survive a kill: each finished epoch leaves all that is needed to go on.

An epoch's randomness depends on seed and number alone, so a resumed training ends with the same
weights as an uninterrupted one.
"""

import json
import math
import os
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from touchgoal.control.errors import UserError

_CHECKPOINT, _METRICS = "checkpoint.pt", "metrics.jsonl"


def check(out_dir: Path, resume: bool, device: str) -> None:
    """Raises UserError if the directory does not fit `resume`, or there is no such device."""
    exists = (out_dir / _CHECKPOINT).is_file()
    if resume and not exists:
        raise UserError(f"nothing to resume in {out_dir}: start without resuming")
    if exists and not resume:
        raise UserError(f"{out_dir} holds a run already: resume it, or choose another directory")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise UserError("no CUDA device here: choose the device cpu")


def shuffle(
    count: int, batch_size: int, seed: int, epoch: int
) -> tuple[torch.Generator, tuple[Int[Tensor, " b"], ...]]:
    """An epoch's generator, and its batches of rows; rows that fill no batch are left out."""
    generator = torch.Generator().manual_seed(seed * 1_000_003 + epoch)
    order = torch.randperm(count, generator=generator)
    return generator, order[: count // batch_size * batch_size].split(batch_size)


def warmed_cosine(step: int, steps: int, warmup: float, final: float = 0.0) -> float:
    """Factor of the learning rate: up from 0 in `warmup` steps, then down to `final` by a cosine."""
    if step < warmup:
        return (step + 1) / (warmup + 1)
    cosine = (1 + math.cos(math.pi * (step - warmup) / max(steps - warmup, 1))) / 2
    return final + (1 - final) * cosine


def save(
    out_dir: Path, setting: str, state: dict[str, Any], history: list[dict[str, float]]
) -> None:
    """Writes the state after an epoch, and `metrics.jsonl`; a kill leaves the old one or this.

    Args:
        out_dir: of the run.
        setting: whatever must be the same when the training goes on.
        state: of networks and optimiser.
        history: metrics of every epoch so far.
    """
    temporary = out_dir / f"{_CHECKPOINT}.tmp"
    torch.save({"setting": setting, "history": history, **state}, temporary)
    os.replace(temporary, out_dir / _CHECKPOINT)
    (out_dir / _METRICS).write_text("".join(json.dumps(epoch) + "\n" for epoch in history))


def restore(out_dir: Path, setting: str, device: str) -> dict[str, Any]:
    """What `save` was given, `history` included; UserError if it is of another training."""
    path = out_dir / _CHECKPOINT
    state = torch.load(path, device, weights_only=True)
    if state["setting"] != setting:
        raise UserError(f"{path} is of another data set, encoder or config: resume with its own")
    return state
