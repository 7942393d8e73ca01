"""Files that are complete or absent: a kill or a power cut never leaves half a file."""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from mmap import mmap
from pathlib import Path

_FULL = 1_000_000  # bytes free, below which a failed write is blamed on the disk


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary name to write to; move the file to `path` once it is on disk.

    Two processes may write the same file at once; the last one stays. Its folder is made if needed. For two files, nest the blocks: the outer block's file is replaced
    last. A block that fails leaves the older file as it was. OSError, with the path, if it cannot be
    written, also where a library reports a full disk by an exception of its own.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        yield unfinished
        _sync(unfinished)
    except Exception as error:
        full = shutil.disk_usage(path.parent).free < _FULL
        number = getattr(error, "errno", None) or (errno.ENOSPC if full else None)
        unfinished.unlink(missing_ok=True)
        if number is None:
            raise
        raise OSError(number, os.strerror(number), str(path)) from error
    os.replace(unfinished, path)
    _sync(path.parent)


def write_file(path: Path, data: bytes | mmap) -> None:
    """Write a file as `atomic_write` does."""
    with atomic_write(path) as unfinished:
        unfinished.write_bytes(data)


def _sync(path: Path) -> None:
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)
