"""One recorder a folder at a time."""

import fcntl
import os
import weakref
from contextlib import suppress
from pathlib import Path

from touchgoal.runtime.errors import UserError


class FolderLock:
    """Holds a folder, made if need be, until released, garbage or the process is gone.

    The kernel keeps the lock, so nothing stale is ever left on disk. A network file system without
    locks is let through: there an `EpisodeWriter` sees another one by its files, later.
    """

    def __init__(self, folder: Path) -> None:
        """Takes the folder.

        Raises:
            UserError: somebody holds it, or it cannot be made.
        """
        made = not folder.exists()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(folder, os.O_RDONLY)
        except OSError as error:
            raise UserError(
                f"cannot record into {folder} ({error.strerror}): give another folder"
            ) from error
        self.release = weakref.finalize(self, _release, folder, descriptor, made)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self.release()
            raise UserError(
                f"something else is recording into {folder}: wait for it or give another folder"
            ) from error
        except OSError:
            pass


def _release(folder: Path, descriptor: int, made: bool) -> None:
    os.close(descriptor)
    if made:
        with suppress(OSError):  # not empty: something was recorded
            folder.rmdir()
