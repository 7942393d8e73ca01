"""Lock that lets one process at a time write into a folder."""

import fcntl
import os
import weakref
from contextlib import suppress
from pathlib import Path

from touchgoal.runtime.errors import UserError


class FolderLock:
    """Lock on a folder (made if needed), held until release, garbage collection or process end.

    The kernel holds it, so that a killed process leaves no stale lock. File systems without locks
    (some network ones) are let through.
    """

    def __init__(
        self,
        folder: Path,
        refusal: str = "something else is recording into {}: wait for it or give another folder",
    ) -> None:
        """Take the lock; {} in the error message `refusal` stands for the folder.

        UserError: another process holds it, or the folder cannot be made.
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
            raise UserError(refusal.format(folder)) from error
        except OSError:
            pass


def _release(folder: Path, descriptor: int, made: bool) -> None:
    os.close(descriptor)
    if made:
        with suppress(OSError):  # not empty: something was recorded
            folder.rmdir()
