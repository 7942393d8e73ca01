"""Options of every training command."""

from pathlib import Path
from typing import Annotated

from touchgoal.control.option_types import RARE, Seed, checked_dataclass
from touchgoal.encoders.config import Precision, RunOptions


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
    precision: Annotated[Precision, RARE] = "no"
    """Mixed precision: bf16 computes in bfloat16 where that is safe. Meant for GPUs: a CPU without
    AVX-512 is 20 times slower with it."""
    resume: bool = False
    """Go on after the last finished epoch of the run in --out."""

    @property
    def run(self) -> RunOptions:
        """For the trainer."""
        return RunOptions(self.seed, self.device, self.precision, self.resume)
