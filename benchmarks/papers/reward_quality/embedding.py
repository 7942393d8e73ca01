"""Embedding of recorded episodes on all cores, each kept in a file, so that an interrupted run continues."""

import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import torch

from benchmarks.papers.reward_quality.recording import Recorded
from touchgoal.control.features import CAMERAS, TACTILE, TRUTH_CONTACT
from touchgoal.encoders import pretrained
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.episodes.store import EpisodeSet
from touchgoal.rewards.features.embedded import ARM, EmbeddedEpisode
from touchgoal.rewards.features.embedder import EpisodeEmbedder
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track


@dataclass(frozen=True)
class EmbeddedFiles:
    """Embedded episodes in a folder, one file each, of one touch encoder."""

    folder: Path
    encoder: str
    every: int = 1  # every n-th frame is embedded, the last one included

    def path(self, recorded: Recorded) -> Path:
        """Return the file of an episode."""
        made_with = load_embedder(self.encoder).made_with
        name = f"{recorded.root.name}-{recorded.index:05d}.pickle"
        return self.folder / f"{made_with.encoder}-{made_with.towers}-{self.every}" / name

    def make(self, recorded: Sequence[Recorded], workers: int) -> None:
        """Embed the episodes that have no file yet."""
        missing = [r for r in recorded if not self.path(r).exists()]
        if not missing:
            return
        with parallel_map(partial(_embed, self), missing, workers) as embedded:
            counted = track(embedded, "embedding", "episode", total=len(missing))
            for one, pickled in zip(missing, counted, strict=True):
                path = self.path(one)
                path.parent.mkdir(parents=True, exist_ok=True)
                write_file(path, pickled)

    def load(self, recorded: Recorded) -> EmbeddedEpisode:
        """Return an embedded episode."""
        return pickle.loads(self.path(recorded).read_bytes())


@cache
def load_embedder(encoder: str) -> EpisodeEmbedder:
    """Return the embedder of a touch encoder, with the towers that it was aligned with."""
    touch = pretrained.load_encoder(encoder)
    return EpisodeEmbedder(load_towers(touch.towers or "offline"), touch)


def _embed(files: EmbeddedFiles, recorded: Recorded) -> bytes:
    torch.set_num_threads(1)
    episodes = EpisodeSet(recorded.root)
    i, embedder = recorded.index, load_embedder(files.encoder)
    keys = [
        key
        for key in (*CAMERAS, *TACTILE, TRUTH_CONTACT, *ARM.values())
        if key in episodes.features
    ]
    frames = range((episodes.lengths[i] - 1) % files.every, episodes.lengths[i], files.every)
    episode, name = episodes.read(i, keys, frames), f"{recorded.root.name}#{i}"
    embedded = embedder.embed_chunks([episode], episodes.fps / files.every, name)
    return pickle.dumps(embedder.describe(embedded, episode.meta))
