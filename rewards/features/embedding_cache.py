"""Embeddings of the episodes of a set, kept on disk, so that no content is embedded twice."""

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

from touchgoal.episodes.embedding_files import embedding_file
from touchgoal.episodes.schema import Episode
from touchgoal.rewards.curves import Contact
from touchgoal.rewards.distance.normalizer import EmbeddingSource
from touchgoal.rewards.features.embedded import EmbeddedEpisode, load_features, save_features
from touchgoal.rewards.features.embedder import EpisodeEmbedder
from touchgoal.rewards.sources.episode_trajectories import EpisodeTrajectory
from touchgoal.rewards.sources.trajectory import Trajectory
from touchgoal.runtime.errors import UserError

_FORMAT = 2  # of the files, and of all code between a frame and its embedding


def embed_trajectory(
    embedder: EpisodeEmbedder, trajectory: Trajectory, chunks: Iterable[Episode] | None = None
) -> EmbeddedEpisode:
    """Return an embedded trajectory: an episode of a set from its file, if there is one.

    Videos are embedded each time. UserError: as `embed_chunks`, or a damaged file.

    Args:
        chunks: the trajectory's frames, if they are read already.
    """
    path = kept_file(embedder, trajectory)
    if path is not None and path.is_file():
        return _load(path, trajectory)
    chunks = trajectory.chunks() if chunks is None else chunks
    about = trajectory.fps, trajectory.source, trajectory.untouched
    embedded = embedder.embed_chunks(chunks, *about)
    if path is not None:
        about = {
            "contact": asdict(embedded.contact),
            "made_with": asdict(embedded.made_with),
            "sides": embedded.sides,
        }
        save_features(path, embedded.features, about)
    return embedded


def kept_file(embedder: EpisodeEmbedder, trajectory: Trajectory) -> Path | None:
    """Return the file of an episode's embedding, named by content and encoders; None for videos."""
    if not isinstance(trajectory, EpisodeTrajectory):
        return None
    read = trajectory.keys, sorted(trajectory.episodes.keys.items())
    made_of = json.dumps([_FORMAT, embedder.fingerprint, read])
    folder = f"rewards-{hashlib.sha256(made_of.encode()).hexdigest()[:16]}"
    return embedding_file(trajectory.episodes, trajectory.index, folder, ".npz")


def _load(path: Path, trajectory: Trajectory) -> EmbeddedEpisode:
    try:
        features, about = load_features(path)
        made_with, contact = EmbeddingSource(**about["made_with"]), Contact(**about["contact"])
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is damaged: delete {path.parent}, which is made again") from error
    embedded = EmbeddedEpisode(
        features, made_with, trajectory.source, trajectory.fps, tuple(about["sides"]), contact
    )
    return embedded.with_facts(trajectory.meta)
