"""Embedding of the trajectories of a source: one after the other here, or side by side on Ray."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

from touchgoal.episodes.schema import Episode
from touchgoal.rewards.features.embedded import EmbeddedEpisode
from touchgoal.rewards.features.embedder import EpisodeEmbedder
from touchgoal.rewards.goals import Inputs
from touchgoal.rewards.report.thumbnails import Thumbnails
from touchgoal.rewards.reward_model import load_embedder
from touchgoal.rewards.sources.read_ahead import read_ahead
from touchgoal.rewards.sources.trajectory import Skipped, Trajectory
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.parallel.parallel_map import parallel_map

Count = Callable[[int], object]
"""Callback with the number of frames done."""


@dataclass(frozen=True)
class EncoderOptions:
    """Options by which a node of a cluster loads the encoders; see `load_reward_model`."""

    inputs: Inputs
    encoder: str | None
    towers: str | None
    with_parts: bool


@dataclass(frozen=True, eq=False)
class Embedded:
    """A trajectory that was read and embedded."""

    trajectory: Trajectory
    embedded: EmbeddedEpisode
    thumbnails: Thumbnails


def embed_here(
    trajectories: Sequence[Trajectory], count: Count, embedder: EpisodeEmbedder, workers: int
) -> Iterator[Embedded | Skipped]:
    """Embed in this process, while `workers` threads read ahead."""
    for trajectory, chunks in read_ahead(trajectories, workers):
        yield _embed(embedder, trajectory, _counted(chunks, count))


def embed_on_ray(
    trajectories: Sequence[Trajectory], count: Count, options: EncoderOptions, address: str
) -> Iterator[Embedded | Skipped]:
    """Embed each trajectory on a core of a Ray cluster, whose nodes read the same files."""
    with parallel_map(partial(_embed_apart, options), trajectories, address) as results:
        for trajectory, result in zip(trajectories, results, strict=True):
            count(trajectory.length)
            yield result


def _embed_apart(options: EncoderOptions, trajectory: Trajectory) -> Embedded | Skipped:
    return _embed(_load(options), trajectory, trajectory.chunks())


@lru_cache(maxsize=1)  # a worker embeds many trajectories
def _load(options: EncoderOptions) -> EpisodeEmbedder:
    embedder, _ = load_embedder(options.inputs, options.encoder, options.towers)
    embedder.with_parts = options.with_parts
    return embedder


def _embed(
    embedder: EpisodeEmbedder, trajectory: Trajectory, chunks: Iterable[Episode]
) -> Embedded | Skipped:
    thumbnails = Thumbnails(trajectory.length)
    try:
        embedded = embedder.embed_chunks(
            thumbnails.collect(chunks), trajectory.fps, trajectory.source
        )
    except UserError as error:
        return Skipped(trajectory.name, str(error))
    return Embedded(trajectory, embedded, thumbnails)


def _counted(chunks: Iterable[Episode], count: Count) -> Iterator[Episode]:
    """Count the frames of a chunk as done when the next one is asked for."""
    for chunk in chunks:
        yield chunk
        count(len(chunk))
