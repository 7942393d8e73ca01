"""Files that are there in full or not at all: a reader, a kill or a power cut never leaves a half one."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Gives the name under which to write; the file takes its place once it is whole and on the disk.

    Of two that are to change together, open the one that is to be replaced last first. A block that
    fails leaves the older file as it was, and what it wrote as PATH.tmp.

    Args:
        path: of the file; its folder is made if needed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(path.name + ".tmp")
    yield unfinished
    _to_disk(unfinished)
    os.replace(unfinished, path)
    _to_disk(path.parent)


def write_file(path: Path, data: bytes) -> None:
    """Writes all of a file, as `atomic_write` does."""
    with atomic_write(path) as unfinished:
        unfinished.write_bytes(data)


def _to_disk(path: Path) -> None:
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)
