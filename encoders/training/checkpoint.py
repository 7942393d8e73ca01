"""Files of a training run after every epoch: a checkpoint to resume from, and metrics."""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from touchgoal.encoders.training.trackers import Trackers
from touchgoal.runtime.atomic_write import atomic_write
from touchgoal.runtime.errors import UserError

CHECKPOINT, _METRICS = "checkpoint.pt", "metrics.jsonl"


def check_run_folder(out_dir: Path, resume: bool) -> None:
    """Raise UserError if there is nothing to resume, or a run would be overwritten."""
    exists = (out_dir / CHECKPOINT).is_file()
    if resume and not exists:
        raise UserError(f"nothing to resume in {out_dir}: start without resuming")
    if not resume and (exists or (out_dir / _METRICS).exists()):
        raise UserError(f"{out_dir} holds a run already: resume it, or choose another directory")


def checksum(*parts: Tensor | np.ndarray | Iterable[str] | None) -> str:
    """Return a short hash of data, to recognise them when a run resumes."""
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
    """Writer of a run's files."""

    def __init__(
        self,
        out_dir: Path,
        identity: Mapping[str, Any],
        provenance: Mapping[str, Any],
        log_with: Sequence[str],
        device: str,
    ) -> None:
        """Open the folder, made if needed, and the trackers named in `log_with` (see `Trackers`).

        `identity`: JSON-able; must be the same when the training resumes.
        """
        out_dir.mkdir(parents=True, exist_ok=True)
        self._dir, self._head = out_dir, {"identity": _json(identity), "provenance": provenance}
        self._trackers = Trackers(log_with, out_dir, {**_json(identity), **provenance}, device)

    def write(self, history: list[dict[str, float]], state: Mapping[str, Any]) -> None:
        """Write the state after an epoch; a kill leaves the old or the new checkpoint, whole."""
        states = {name: part.state_dict() for name, part in state.items()}
        with atomic_write(self._dir / CHECKPOINT) as unfinished:
            torch.save({**self._head, "history": history, **states}, unfinished)
        lines = "".join(json.dumps(epoch) + "\n" for epoch in history)
        (self._dir / _METRICS).write_text(lines)
        curves = {name: value for name, value in history[-1].items() if name != "epoch"}
        self._trackers.log(curves, len(history))

    def close(self) -> None:
        """End the trackers."""
        self._trackers.close()


def load(
    out_dir: Path,
    identity: Mapping[str, Any],
    state: Mapping[str, Any],
    provenance: Mapping[str, Any],
) -> tuple[list[dict[str, float]], dict[str, Any]]:
    """Load what `Record.write` wrote into `state`.

    Returns the metrics of every epoch so far, and the run's provenance. UserError: the checkpoint
    is damaged, or of another training.

    Args:
        state: Modules, optimizers and the like, by name; loaded to the device of each.
        provenance: Provenance of the resumption, added if it differs.
    """
    path = out_dir / CHECKPOINT
    try:
        found = torch.load(path, "cpu", weights_only=True)
        old, history, recorded = found["identity"], found["history"], found["provenance"]
    except Exception as error:  # torch.load raises whatever its parts raise
        raise UserError(f"{path} cannot be read: start again in another directory") from error
    if difference := _difference(old, _json(identity)):
        raise UserError(
            f"{path} is of another data set, encoder or config ({difference}): resume with its own"
        )
    for name, part in state.items():
        part.load_state_dict(found[name])
    if provenance != recorded and provenance not in (resumed := recorded.get("resumed", [])):
        recorded = {**recorded, "resumed": [*resumed, dict(provenance)]}
    return history, recorded


def _json(value: Mapping[str, Any]) -> dict[str, Any]:
    return json.loads(json.dumps(value))


def _difference(old: Any, new: Any, name: str = "") -> str:
    """Return the first value that differs, before and now; "" if none does."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in {**old, **new}:
            inner = f"{name}.{key}" if name else str(key)
            if found := _difference(old.get(key), new.get(key), inner):
                return found
        return ""
    return "" if old == new else f"{name} was {old}, is {new}"
