"""Options of every training command."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from touchgoal.encoders.config import TrainerOptions
from touchgoal.runtime.option_types import checked_dataclass


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
class UnlabelledData:
    """What is learned from without labels, and where what was learned is left."""

    data: Annotated[tuple[Path, ...], Field(min_length=1)]
    """What to learn from, one folder or several of one sensor: sets of episodes; published recordings as
    pickles (YCB-Slide, Touch-Slide, Touch-and-Go, ObjectFolder); videos with labels.csv, as PhysiCLeAR has
    them. Recordings that a folder holds out are not learned from."""
    validation: tuple[Path, ...] = ()
    """Other such folders, on which what was learned is measured, besides what --data holds out. Sets of
    episodes hold nothing out, and need one."""
    out: Path | None = None
    """Folder of the run."""


@checked_dataclass
class TrainedOptions(TrainerOptions):
    """Options of the trainer, with those of what it trains."""

    out: Path | None = None
    """Folder of the run."""

    @property
    def trainer(self) -> TrainerOptions:
        """The trainer's part."""
        return TrainerOptions(self.seed, self.device, self.precision, self.resume)


@checked_dataclass
class TrainingOptions(TrainedOptions, DataOptions):
    """Options of every training command; in its help those of the last base come first."""


@checked_dataclass
class UnlabelledOptions(TrainedOptions, UnlabelledData):
    """Options of every training without labels."""

    out: Path | None = None
    """Folder of the run; the encoder goes to its `encoder/`."""
    sensor: str | None = None
    """Fingertip sensor, for episodes that do not name theirs."""
