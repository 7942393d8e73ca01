"""Start of a training run: checks before any data are read, the run's folder, its provenance."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from touchgoal.encoders.training.checkpoint import check_run_folder
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.encoders.training.trackers import check_trackers
from touchgoal.encoders.training.trainer import check_device
from touchgoal.episodes.format.joined import load_episodes
from touchgoal.episodes.overlap import require_no_shared_frames
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.provenance import provenance
from touchgoal.runtime.run_folder import open_run


def check_run(options: TrainerOptions, out: Path | None) -> None:
    """Check device, trackers and folder; UserError: no such one, an unfit folder, none where one is needed."""
    check_device(options.device)
    check_trackers(options.log_with)
    if out is None and options.resume:
        raise UserError("to resume a run, name its folder with --out")
    if out is None and int(os.environ.get("WORLD_SIZE", 1)) > 1:
        raise UserError("several processes need one folder: name it with --out")
    if out is not None:
        check_run_folder(out, options.resume)


def check_one_process(method: str) -> None:
    """Raise UserError under torchrun: a fit in closed form has no batches to share."""
    if int(os.environ.get("WORLD_SIZE", 1)) > 1:
        raise UserError(f"train-encoder {method} runs in one process: start it without torchrun")


def open_training(config: Any, command: str) -> Path:
    """Open the folder of a run with `TrainerOptions`; the first of several processes records it."""
    if int(os.environ.get("RANK", 0)) and config.out is not None:
        return config.out
    return open_run(config.out, command, config, adds=config.resume)


def open_sets(
    data: Path, validation: Path, keys: Mapping[str, str]
) -> tuple[EpisodeSet, EpisodeSet]:
    """Open the training and the validation set, or many as one; see `load_episodes`.

    UserError: they are the same, share frames, or are damaged.
    """
    if data.resolve() == validation.resolve():
        raise UserError(
            f"--data and --validation are both {data}: validate on episodes that are not trained on"
        )
    sets = load_episodes(data, keys), load_episodes(validation, keys)
    require_no_shared_frames(*sets)
    return sets


def recipe(data: EpisodeSet, validation: EpisodeSet) -> dict[str, Any]:
    """Return the provenance of a training: command, code and data."""
    return {
        **provenance(),
        "episodes": len(data),
        "validation_episodes": len(validation),
        "data": {
            name: {
                "path": str(episodes.root),
                "episodes": len(episodes),
                "checksum": episodes.checksum,
            }
            for name, episodes in (("train", data), ("validation", validation))
        },
    }
