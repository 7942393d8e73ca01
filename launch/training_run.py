"""What every training command checks before any work, and records beside what it made."""

import os
from pathlib import Path
from typing import Any

from touchgoal.control.errors import UserError
from touchgoal.control.option_types import Seed, checked_dataclass
from touchgoal.control.provenance import provenance
from touchgoal.encoders.config import Precision, RunOptions
from touchgoal.encoders.training.checkpoint import check_run_folder
from touchgoal.encoders.training.trainer import check_device
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch.run_folder import open_run


@checked_dataclass
class TrainingOptions:
    """Options of every training command."""

    data: Path
    """Set of episodes to learn from."""
    validation: Path
    """Set of other episodes, on which what was learned is measured."""
    out: Path | None = None
    """Folder of the run."""
    seed: Seed = 0
    """Random seed of initial weights, order of the data and noise."""
    device: str = "cpu"
    """Where to train: cpu, cuda, cuda:<number> or mps. Under torchrun each process takes a GPU of its
    own."""
    precision: Precision = "no"
    """Mixed precision: bf16 computes in bfloat16 where that is safe. Meant for GPUs: a CPU without
    AVX-512 is 20 times slower with it."""
    resume: bool = False
    """Go on after the last finished epoch of the run in --out."""

    @property
    def run(self) -> RunOptions:
        """For the trainer."""
        return RunOptions(self.seed, self.device, self.precision, self.resume)


def check_training(options: RunOptions, out: Path | None, first: str = "") -> None:
    """Checks what can be checked before any data are read.

    Args:
        options: Of the training.
        out: Folder of the run.
        first: Folder in it of the run's first training, if it has several.

    Raises:
        UserError: No such device, an unfit folder, or no folder where there must be one.
    """
    check_device(options.device)
    if out is None and options.resume:
        raise UserError("to resume a run, name its folder with --out")
    if out is None and int(os.environ.get("WORLD_SIZE", 1)) > 1:
        raise UserError("several processes need one folder: name it with --out")
    if out is not None:
        check_run_folder(out / first, options.resume)


def open_training(config: TrainingOptions, command: str) -> Path:
    """Opens the run's folder; of several processes the first one writes the record."""
    if int(os.environ.get("RANK", 0)) and config.out is not None:
        return config.out
    return open_run(config.out, command, config, adds=config.resume)


def open_sets(data: Path, validation: Path) -> tuple[EpisodeSet, EpisodeSet]:
    """The episodes to learn from and those to judge by.

    Raises:
        UserError: They are the same, or damaged.
    """
    if data.resolve() == validation.resolve():
        raise UserError(
            f"--data and --validation are both {data}: judge by episodes that are not learned from"
        )
    return EpisodeSet(data), EpisodeSet(validation)


def recipe(data: EpisodeSet, validation: EpisodeSet) -> dict[str, Any]:
    """Provenance of what was trained: command, code and data."""
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
