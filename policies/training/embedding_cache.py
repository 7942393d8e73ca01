"""Embeddings of recorded episodes by a frozen encoder, cached inside the episode set."""

from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float16

from touchgoal.episodes.embedding_files import embedding_file
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.atomic_write import atomic_write
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.parallel.parallel_map import Workers, parallel_map
from touchgoal.runtime.progress import track


@runtime_checkable
class Embedder(Protocol):
    """Frozen encoder of an episode's ticks."""

    name: str  # identifies the embeddings
    shape: tuple[int, ...]  # shape of one tick's embedding

    def embed(self, episodes: EpisodeSet, i: int) -> np.ndarray:
        """Embed all ticks of an episode."""
        ...


def embed_episodes(
    episodes: EpisodeSet, chosen: Sequence[int], embedder: Embedder, workers: Workers = 1
) -> list[Float16[np.ndarray, "t ..."]]:
    """Return the embeddings of episodes, from the cache or made and cached.

    A kill loses those in progress.
    """
    paths = {i: embedding_file(episodes, i, embedder.name, ".npy") for i in chosen}
    missing = [i for i, path in paths.items() if not path.exists()]
    embed = partial(embed_episode, episodes, embedder)
    with (
        nullcontext(map(embed, missing))
        if workers == 1 or not missing
        else parallel_map(embed, missing, workers) as embedded
    ):
        counted = track(embedded, "embedding", "episode", total=len(missing)) if missing else ()
        for i, rows in zip(missing, counted, strict=True):
            with atomic_write(paths[i]) as unfinished, unfinished.open("wb") as file:
                np.save(file, rows)
    return [cached_embeddings(episodes, i, embedder) for i in chosen]


def cached_embeddings(
    episodes: EpisodeSet, i: int, embedder: Embedder
) -> Float16[np.ndarray, "t ..."]:
    """Return the cached embeddings of an episode; UserError if they are damaged."""
    path = embedding_file(episodes, i, embedder.name, ".npy")
    rows = np.load(path)
    if rows.shape != (episodes.lengths[i], *embedder.shape):
        raise UserError(f"{path} is damaged: delete {path.parent}, which is made again")
    return rows


def embed_episode(episodes: EpisodeSet, embedder: Embedder, i: int) -> Float16[np.ndarray, "t ..."]:
    """Embed all ticks of an episode on one thread."""
    torch.set_num_threads(1)
    return embedder.embed(episodes, i).astype(np.float16)
