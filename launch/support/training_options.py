"""Options of every training command."""

from pathlib import Path

from touchgoal.control.option_types import checked_dataclass
from touchgoal.encoders.config import TrainerOptions


@checked_dataclass
class DataOptions:
    """What a training learns from, and where it leaves what it learned."""

    data: Path
    """Set of episodes to learn from."""
    validation: Path
    """Set of other episodes, on which what was learned is measured."""
    out: Path | None = None
    """Folder of the run."""


@checked_dataclass
class TrainingOptions(TrainerOptions, DataOptions):
    """Options of every training command; in its help those of the last base come first."""

    @property
    def trainer(self) -> TrainerOptions:
        """The trainer's part."""
        return TrainerOptions(self.seed, self.device, self.precision, self.resume)
