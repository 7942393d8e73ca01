"""Options of every training command; light to import, because `touchgoal --help` shows them."""

from pathlib import Path
from typing import Annotated, Literal

from touchgoal.runtime.option_types import RARE, Seed, checked_dataclass

Precision = Literal["no", "bf16"]


@checked_dataclass
class TrainerOptions:
    """Seed, device, precision and resumption of a training."""

    seed: Seed = 0
    """Random seed of the initial weights, the order of the data and the noise."""
    device: str = "cpu"
    """Device to train on: cpu, cuda, cuda:<number> or mps. Under torchrun each process takes its own
    GPU."""
    precision: Annotated[Precision, RARE] = "no"
    """Mixed precision: bf16 computes in bfloat16 where that is safe, weights stay float32. For GPUs: a
    CPU without AVX-512 is 20 times slower with it."""
    log_with: Annotated[tuple[str, ...], RARE] = ("tensorboard",)
    """Where the curves go: tensorboard (files in --out), wandb, trackio, or another of Accelerate's trackers
    that is installed."""
    resume: bool = False
    """Continue the run in --out after its last finished epoch."""


@checked_dataclass
class SetTrainerOptions(TrainerOptions):
    """Options of a training on episode sets."""

    keys: Annotated[tuple[str, ...], RARE] = ()
    """Keys of a LeRobot set whose features have other names: STORED=KEY, such as
    observation.images.top=observation.images.front."""


@checked_dataclass
class DataOptions:
    """Data of a training and the folder of its run."""

    data: Path
    """Episode set to train on."""
    validation: Path
    """Episode set to validate on; it must share no recording with --data."""
    out: Path | None = None
    """Folder of the run."""


@checked_dataclass
class TrainingOptions(SetTrainerOptions, DataOptions):
    """Options of every training on episodes; `--help` lists those of the last base first."""
