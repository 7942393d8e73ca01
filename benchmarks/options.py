"""Options that every benchmark has."""

import os
from pathlib import Path

from touchgoal.runtime.option_types import checked_dataclass

CORES = os.cpu_count() or 1


@checked_dataclass
class BenchmarkOptions:
    """Options of every benchmark."""

    out: Path | None = None
    """Folder of the run."""
