"""Files in which embeddings of recorded episodes are kept: one for each content and encoder."""

import os
from pathlib import Path

from touchgoal.episodes.format.remote import cache_folder
from touchgoal.episodes.store import EpisodeSet


def embedding_file(episodes: EpisodeSet, i: int, encoder: str, suffix: str) -> Path:
    """Return the file of episode i, which may not exist yet; its name is a hash of the content.

    It lies in the set's folder `.cache/embeddings`; for a set that cannot be written, in the user's
    cache folder.

    Args:
        encoder: name that changes with the encoder's weights and preprocessor.
        suffix: ending of the file, such as ".npy".
    """
    episodes, i = episodes.part(i)
    kept = episodes.root / ".cache" if os.access(episodes.root, os.W_OK) else cache_folder()
    folder = kept / "embeddings" / encoder.replace("/", "_")
    return folder / f"{episodes.episode_checksum(i)[:32]}{suffix}"
