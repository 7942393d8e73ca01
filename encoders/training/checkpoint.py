"""What a training leaves on disk after every epoch: all that is needed to go on, and its metrics."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from touchgoal.runtime.atomic_write import atomic_write
from touchgoal.runtime.errors import UserError

_CHECKPOINT, _METRICS = "checkpoint.pt", "metrics.jsonl"


def has_checkpoint(out_dir: Path) -> bool:
    """Whether a run has finished an epoch there."""
    return (out_dir / _CHECKPOINT).is_file()


def check_run_folder(out_dir: Path, resume: bool) -> None:
    """Raises UserError if there is nothing to resume, or an older run that must not be overwritten."""
    exists = has_checkpoint(out_dir)
    if resume and not exists:
        raise UserError(f"nothing to resume in {out_dir}: start without resuming")
    if not resume and (exists or (out_dir / _METRICS).exists()):
        raise UserError(f"{out_dir} holds a run already: resume it, or choose another directory")


def checksum(*parts: Tensor | np.ndarray | Iterable[str] | None) -> str:
    """A short hash of data, by which a resumed run knows that they are the same."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Tensor):
            part = part.numpy()
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype}{part.shape}".encode())
            digest.update(np.ascontiguousarray(part).data)
        else:
            digest.update(json.dumps(None if part is None else list(part)).encode())
    return digest.hexdigest()[:16]


class Record:
    """Writes a run's files."""

    def __init__(
        self, out_dir: Path, identity: Mapping[str, Any], provenance: Mapping[str, Any]
    ) -> None:
        """For a run.

        Args:
            out_dir: Made if needed.
            identity: JSON-able: whatever must be the same when the training goes on.
            provenance: JSON-able: where the run comes from.
        """
        from torch.utils.tensorboard import SummaryWriter  # slow to import

        out_dir.mkdir(parents=True, exist_ok=True)
        self._dir, self._head = out_dir, {"identity": _json(identity), "provenance": provenance}
        self._tensorboard = SummaryWriter(str(out_dir))

    def write(self, history: list[dict[str, float]], state: Mapping[str, Any]) -> None:
        """Writes what there is after an epoch; a kill leaves the older files or these.

        Args:
            history: Metrics of every epoch so far.
            state: Modules, optimizers and the like, by name.
        """
        states = {name: part.state_dict() for name, part in state.items()}
        with atomic_write(self._dir / _CHECKPOINT) as unfinished:
            torch.save({**self._head, "history": history, **states}, unfinished)
        lines = "".join(json.dumps(epoch) + "\n" for epoch in history)
        (self._dir / _METRICS).write_text(lines)
        for name, value in history[-1].items():
            if name != "epoch" and value is not None:
                self._tensorboard.add_scalar(name, value, len(history))
        self._tensorboard.flush()

    def close(self) -> None:
        """Closes TensorBoard's file."""
        self._tensorboard.close()


def load(
    out_dir: Path,
    identity: Mapping[str, Any],
    state: Mapping[str, Any],
    provenance: Mapping[str, Any],
) -> tuple[list[dict[str, float]], dict[str, Any]]:
    """Fills `state` with what `Record.write` was given.

    Args:
        out_dir: Of the run.
        identity: Of the run that is to go on.
        state: Modules, optimizers and the like, by name; loaded to where each is.
        provenance: Of the resumption, which is noted if it differs.

    Returns:
        The metrics of every epoch so far, and the run's provenance.

    Raises:
        UserError: It is damaged, or of another training.
    """
    path = out_dir / _CHECKPOINT
    try:
        found = torch.load(path, "cpu", weights_only=True)
        old, history, kept = found["identity"], found["history"], found["provenance"]
    except Exception as error:  # torch.load raises whatever its parts raise
        raise UserError(f"{path} cannot be read: start again in another directory") from error
    if difference := _difference(old, _json(identity)):
        raise UserError(
            f"{path} is of another data set, encoder or config ({difference}): resume with its own"
        )
    for name, part in state.items():
        part.load_state_dict(found[name])
    if provenance != kept and provenance not in (resumed := kept.get("resumed", [])):
        kept = {**kept, "resumed": [*resumed, dict(provenance)]}
    return history, kept


def _json(value: Mapping[str, Any]) -> dict[str, Any]:
    return json.loads(json.dumps(value))


def _difference(old: Any, new: Any, name: str = "") -> str:
    """Says of the first value that differs what it was and is; "" if none does."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in {**old, **new}:
            inner = f"{name}.{key}" if name else str(key)
            if found := _difference(old.get(key), new.get(key), inner):
                return found
        return ""
    return "" if old == new else f"{name} was {old}, is {new}"
