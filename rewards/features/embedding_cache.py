"""Embeddings of the episodes of a set, kept on disk, so that no content is embedded twice."""

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from touchgoal.control.features import TACTILE
from touchgoal.episodes.embedding_files import embedding_file
from touchgoal.episodes.schema import Episode, is_camera
from touchgoal.rewards.curves import Contact
from touchgoal.rewards.distance.normalizer import EmbeddingSource
from touchgoal.rewards.features.embedded import TOUCH, EmbeddedEpisode, load_features, save_features
from touchgoal.rewards.features.embedder import EpisodeEmbedder
from touchgoal.rewards.judging.end_state import carried_row, put_down
from touchgoal.rewards.metrics import START_FRAMES
from touchgoal.rewards.sources.episode_trajectories import EpisodeTrajectory
from touchgoal.rewards.sources.trajectory import Trajectory
from touchgoal.runtime.errors import UserError

_FORMAT = 4  # of the files, and of all code between a frame and its embedding


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
    return _keep(path, embedder.embed_chunks(chunks, *about))


def embed_end(embedder: EpisodeEmbedder, trajectory: Trajectory) -> EmbeddedEpisode:
    """Return what `end_costs` reads of an episode, from a file if there is one.

    That is contact and arm at all frames, cameras at the last one, and the touch embedding at two: the
    last one, and the `carried_row`, which stands for all frames until then. A video is embedded
    whole.
    """
    if not isinstance(trajectory, EpisodeTrajectory):
        return embed_trajectory(embedder, trajectory)
    for path in (kept_file(embedder, trajectory), kept_file(embedder, trajectory, "end")):
        if path is not None and path.is_file():
            return _load(path, trajectory)
    last, about = trajectory.length - 1, (trajectory.fps, trajectory.source)
    end = trajectory.read([last])
    felt = replace(trajectory, keys=tuple(key for key in trajectory.keys if not is_camera(key)))
    if embedder.encoder is None or not set(TACTILE) & set(felt.keys):
        return _keep(path, embedder.embed_chunks([end], *about))
    contact = embedder.embed_chunks(felt.chunks(), *about, touch=False)
    down, past = put_down(contact.features, trajectory.fps), max(embedder.encoder.offsets)
    before = carried_row(contact.features, down)
    rows = [*range(min(START_FRAMES, last)), *range(max(before - past, 0), before + 1)]
    again = felt.read([*rows, *range(max(last - past, 0), last + 1)])
    touch = embedder.embed_chunks([again], *about).features[TOUCH][[len(rows) - 1, -1]]
    features = {
        **embedder.embed_cameras(end.frames),
        **contact.features,
        TOUCH: np.repeat(touch, [before + 1, last - before], axis=0),
    }
    return _keep(path, replace(contact, features=features))


def kept_file(embedder: EpisodeEmbedder, trajectory: Trajectory, *of: str) -> Path | None:
    """Return the file of an episode's embedding, named by content and encoders; None for videos."""
    if not isinstance(trajectory, EpisodeTrajectory):
        return None
    read = trajectory.keys, sorted(trajectory.episodes.keys.items()), *of
    made_of = json.dumps([_FORMAT, embedder.fingerprint, read])
    folder = f"rewards-{hashlib.sha256(made_of.encode()).hexdigest()[:16]}"
    return embedding_file(trajectory.episodes, trajectory.index, folder, ".npz")


def _keep(path: Path | None, embedded: EmbeddedEpisode) -> EmbeddedEpisode:
    if path is not None:
        about = {
            "contact": asdict(embedded.contact),
            "made_with": asdict(embedded.made_with),
            "sides": embedded.sides,
        }
        save_features(path, embedded.features, about)
    return embedded


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
