"""Measure every trajectory of a source; broken ones are skipped, measured ones are not repeated."""

import csv
import hashlib
import io
import json
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from touchgoal.encoders.training.checkpoint import checksum
from touchgoal.rewards.embed_trajectories import Count, Embedded
from touchgoal.rewards.goals import GoalSpec, content_checksum
from touchgoal.rewards.report.record import record_of
from touchgoal.rewards.report.report import write_report
from touchgoal.rewards.reward_model import RewardModel
from touchgoal.rewards.sources.trajectory import Skipped, Trajectory
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import progress_bar
from touchgoal.runtime.version import __version__

SKIPPED = "skipped.csv"
_RECORDS = "measured"
Embed = Callable[[Sequence[Trajectory], Count], Iterator[Embedded | Skipped]]
"""Embeds trajectories in their order."""


class Measurement:
    """The measurement of some trajectories into the folder of a run."""

    def __init__(
        self,
        trajectories: Sequence[Trajectory],
        model_of: Callable[[Trajectory], RewardModel],
        out: Path,
        gamma: float,
        plots: int,
    ) -> None:
        """Find out what is measured already.

        Args:
            gamma: discount factor of the potential-based reward.
            plots: number of trajectories, from the first, that get a plot.
        """
        self._out, self._gamma = out, gamma
        self._models = {t.name: model_of(t) for t in trajectories}
        self._contents: dict[str, str] = {}
        self._plotted = {t.name for t in trajectories[:plots]}
        self._paths = {t.name: self._path(t) for t in trajectories}
        self.missing = [t for t in trajectories if not self._paths[t.name].is_file()]
        self.skipped: list[Skipped] = []

    @property
    def records(self) -> list[Path]:
        """Records of the measured trajectories, in the order of the source."""
        return [path for path in self._paths.values() if path.is_file()]

    def run(self, embed: Embed) -> str:
        """Measure what is missing, embedded by `embed`; add what cannot be read to `skipped`.

        Each trajectory is on disk when the next one begins. Return number and rate of the frames and
        the largest memory, for people.
        """
        done, began = 0, time.perf_counter()
        with progress_bar("measuring", sum(t.length for t in self.missing), "frame") as bar:
            for trajectory, result in zip(
                self.missing, embed(self.missing, bar.update), strict=True
            ):
                try:
                    self._measure(result)
                except UserError as error:
                    self.skipped.append(Skipped(trajectory.name, str(error)))
                done += trajectory.length
                bar.update(done - bar.n)
        seconds = time.perf_counter() - began
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6  # GB: Linux counts in kB
        rate = f"{done / seconds:.1f} a second, at most {memory:.2f} GB of memory"
        return f"{done:,} frames in {seconds:.0f} s: {rate}"

    def _measure(self, result: Embedded | Skipped) -> None:
        if isinstance(result, Skipped):
            self.skipped.append(result)
            return
        trajectory, name = result.trajectory, result.trajectory.name
        model = self._models[name]
        curves = model.curves(result.embedded)
        plot = name in self._plotted
        write_report(curves, self._out, name, model.provenance(), self._gamma, plot)
        path = self._paths[name]
        for stale in path.parent.glob(f"{name}.*.npz"):
            stale.unlink()
        record_of(curves, trajectory, result.thumbnails, self._gamma).save(path)

    def _content(self, spec: GoalSpec) -> str:
        """Return the checksum of a goal's content, read once: thousands of trajectories share it."""
        key = str(spec)
        if key not in self._contents:
            self._contents[key] = content_checksum(spec)
        return self._contents[key]

    def _path(self, trajectory: Trajectory) -> Path:
        """Return the path of a record, which names the recording and what it was measured with."""
        model = self._models[trajectory.name]
        made_of = [
            __version__,
            trajectory.checksum(),
            model.provenance(),
            model.goal.as_dict(),
            [self._content(spec) for spec in model.goal.specs],
            repr(model.normalizer),
            checksum(*(model.value.state_dict().values() if model.value else ())),
            self._gamma,
        ]
        digest = hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()[:12]
        return self._out / _RECORDS / f"{trajectory.name}.{digest}.npz"


def write_skipped(skipped: Sequence[Skipped], total: int, out: Path) -> str:
    """Write skipped.csv and return a line for people; without any, remove the file."""
    path = out / SKIPPED
    if not skipped:
        path.unlink(missing_ok=True)
        return f"{total:,} measured"
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["name", "reason"])
    writer.writerows((one.name, one.reason) for one in skipped)
    write_file(path, text.getvalue().encode())
    return f"{len(skipped):,} of {total:,} skipped, see {path}"
