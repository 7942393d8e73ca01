"""Measure every trajectory of a source, one after the other here or side by side on Ray.

Broken ones are skipped, measured ones are not repeated.
"""

import csv
import hashlib
import json
import resource
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path

from touchgoal.encoders.training.checkpoint import checksum
from touchgoal.episodes.schema import Episode
from touchgoal.rewards.features.embedded import EmbeddedEpisode
from touchgoal.rewards.features.embedder import EpisodeEmbedder
from touchgoal.rewards.features.embedding_cache import embed_trajectory, kept_file
from touchgoal.rewards.goals import Inputs, content_checksum
from touchgoal.rewards.prepared_reward import PreparedReward
from touchgoal.rewards.report.record import record_of
from touchgoal.rewards.report.report import write_report
from touchgoal.rewards.report.thumbnails import Thumbnails
from touchgoal.rewards.reward import Reward
from touchgoal.rewards.sources.episode_trajectories import EpisodeTrajectory
from touchgoal.rewards.sources.trajectory import Skipped, Trajectory, read_ahead
from touchgoal.runtime.atomic_write import atomic_write
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import progress_bar
from touchgoal.runtime.version import __version__

SKIPPED = "skipped.csv"
_RECORDS, _FORMAT = "measured", 4
Count = Callable[[int], object]
"""Callback with the number of frames done."""
EncoderOptions = tuple[Inputs, str | None, str | None, bool]
"""Inputs, touch encoder, towers and parts."""
Result = tuple[EmbeddedEpisode, Thumbnails] | Skipped
Embed = Callable[[Sequence[Trajectory], Count], Iterator[Result]]
"""Embeds trajectories in their order."""


class Measurement:
    """The measurement of some trajectories into the folder of a run."""

    def __init__(
        self,
        trajectories: Sequence[Trajectory],
        rewards: Mapping[str, PreparedReward],
        out: Path,
        plots: int,
    ) -> None:
        """Find out what is measured already.

        Args:
            rewards: the reward of each trajectory, by name.
            plots: number of trajectories, from the first, that get a plot.
        """
        self._out, self._rewards = out, rewards
        # thousands of trajectories share a goal, whose content is read once
        goals = {str(goal): goal for reward in rewards.values() for goal in reward.goals.values()}
        contents = {name: content_checksum(goal) for name, goal in goals.items()}
        self._plotted = {t.name for t in trajectories[:plots]}
        self._paths = {t.name: self._path(t, contents) for t in trajectories}
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
            results = embed(self.missing, bar.update)
            for trajectory, result in zip(self.missing, results, strict=True):
                if isinstance(result, Skipped):
                    self.skipped.append(result)
                else:
                    self._measure(trajectory, *result)
                done += trajectory.length
                bar.update(done - bar.n)
        seconds = time.perf_counter() - began
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6  # GB: Linux counts in kB
        rate = f"{done / seconds:.1f} a second, at most {memory:.2f} GB of memory"
        return f"{done:,} frames in {seconds:.0f} s: {rate}"

    def _measure(
        self, trajectory: Trajectory, embedded: EmbeddedEpisode, thumbnails: Thumbnails
    ) -> None:
        name, meta = trajectory.name, trajectory.meta
        reward, path = self._rewards[name], self._paths[name]
        try:
            curves = reward.curves(embedded)
        except UserError as error:
            self.skipped.append(Skipped(name, str(error)))
            return
        about = ", ".join(str(meta[k]) for k in ("object", "outcome") if meta.get(k))
        write_report(curves, self._out, name, name in self._plotted, about)
        for stale in path.parent.glob(f"{name}.*.npz"):
            stale.unlink()
        record_of(curves, trajectory, thumbnails).save(path)

    def _path(self, trajectory: Trajectory, contents: Mapping[str, str]) -> Path:
        """Return the path of a record, which names the recording and what it was measured with."""
        reward = self._rewards[trajectory.name]
        made_of = [
            _FORMAT,
            __version__,
            trajectory.checksum(),
            reward.provenance(),
            reward.plain,
            {m: (str(goal), contents[str(goal)]) for m, goal in reward.goals.items()},
            repr(reward.normalizer),
            checksum(*(reward.value.state_dict().values() if reward.value else ())),
        ]
        digest = hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()[:12]
        return self._out / _RECORDS / f"{trajectory.name}.{digest}.npz"


def embed_here(
    trajectories: Sequence[Trajectory], count: Count, embedder: EpisodeEmbedder
) -> Iterator[Result]:
    """Embed in this process, while threads read ahead what is not embedded yet."""
    kept = {t.name for t in trajectories if (p := kept_file(embedder, t)) and p.is_file()}
    reading = read_ahead(t for t in trajectories if t.name not in kept)
    for trajectory in trajectories:
        chunks = () if trajectory.name in kept else _counted(next(reading), count)
        yield _embed(embedder, trajectory, chunks)


def embed_on_ray(
    trajectories: Sequence[Trajectory], count: Count, address: str, encoders: EncoderOptions
) -> Iterator[Result]:
    """Embed each trajectory on a core of a Ray cluster, whose nodes read the same files.

    With `encoders` each node loads them; see `Reward`.
    """
    with parallel_map(partial(_embed_apart, encoders), trajectories, address) as results:
        for trajectory, result in zip(trajectories, results, strict=True):
            count(trajectory.length)
            yield result


def _embed_apart(encoders: EncoderOptions, trajectory: Trajectory) -> Result:
    return _embed(_load(*encoders), trajectory, trajectory.chunks())


@lru_cache(maxsize=1)  # a worker embeds many trajectories
def _load(inputs: Inputs, encoder: str | None, towers: str | None, parts: bool) -> EpisodeEmbedder:
    return Reward(encoder=encoder, towers=towers).embedder(inputs, parts)


def _embed(embedder: EpisodeEmbedder, trajectory: Trajectory, chunks: Iterable[Episode]) -> Result:
    thumbnails = Thumbnails(trajectory.length)
    try:
        embedded = embed_trajectory(embedder, trajectory, thumbnails.collect(chunks))
        if not thumbnails.shown and isinstance(trajectory, EpisodeTrajectory):  # it was embedded
            thumbnails.add(trajectory.read(thumbnails.planned))
    except UserError as error:
        return Skipped(trajectory.name, str(error))
    return embedded, thumbnails


def _counted(chunks: Iterable[Episode], count: Count) -> Iterator[Episode]:
    """Count the frames of a chunk as done when the next one is asked for."""
    for chunk in chunks:
        yield chunk
        count(len(chunk))


def write_skipped(skipped: Sequence[Skipped], total: int, out: Path) -> str:
    """Write skipped.csv and return a line for people; without any, remove the file."""
    path = out / SKIPPED
    if not skipped:
        path.unlink(missing_ok=True)
        return f"{total:,} measured"
    rows = [("name", "reason"), *((one.name, one.reason) for one in skipped)]
    with atomic_write(path) as unfinished, unfinished.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)
    return f"{len(skipped):,} of {total:,} skipped, see {path}"
