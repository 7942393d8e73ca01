"""Frame of a command's process: streams, the recorded command line, mistakes told in one line."""

import errno
import io
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from touchgoal.runtime.errors import UserError
from touchgoal.runtime.interruption import Terminated, terminable
from touchgoal.runtime.json_file import write_json
from touchgoal.runtime.run_folder import release_runs

_WRITE_ERRORS = {  # errno -> advice
    **dict.fromkeys((errno.EFBIG, errno.EIO, errno.EROFS, errno.EACCES, errno.EPERM), ""),
    **dict.fromkeys((errno.ENAMETOOLONG, errno.ELOOP), ""),
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), ": free some space and run the command again"),
    errno.EMFILE: ": raise the limit with ulimit -n",
}


def run_command(program: str, arguments: list[str], action: Callable[..., None]) -> None:
    """Call `action(*arguments)`, a command's name and options, as `program`.

    With `--traceback` among them a user's mistake shows its traceback, as a bug does. Exit status: 1 after a user's mistake or a failed write, in one line on stderr (2 if tyro finds
    it), 130 after Ctrl-C and 143 after SIGTERM.
    """
    prog, whole = f"{program} {arguments[0]}", "--traceback" in arguments
    arguments = [argument for argument in arguments if argument != "--traceback"]
    before, sys.argv = sys.argv, [program, *arguments]  # the command that the run's record names
    try:
        with terminable():
            _report_errors(prog, action, arguments, whole)
    finally:
        sys.argv = before


def _report_errors(
    prog: str, action: Callable[..., None], arguments: list[str], whole: bool
) -> None:
    try:
        _require_working_directory()
        action(*arguments)
    except UserError as error:
        _tell_torchrun(f"{prog}: {error}")
        if whole:
            raise
        sys.exit(f"{prog}: {error}")
    except OSError as error:
        if error.errno not in _WRITE_ERRORS:
            raise
        where = f"{error.filename}: " if error.filename else ""
        sys.exit(f"{prog}: {where}{os.strerror(error.errno)}{_WRITE_ERRORS[error.errno]}")
    except KeyboardInterrupt as interruption:
        stopped = "; ".join(["stopped", *getattr(interruption, "__notes__", [])])
        print(f"\n{prog}: {stopped}", file=sys.stderr)
        stopped_by = signal.SIGTERM if isinstance(interruption, Terminated) else signal.SIGINT
        sys.exit(128 + stopped_by)
    finally:
        release_runs()


def _tell_torchrun(message: str) -> None:
    """Leave the message where torchrun, which prints a traceback of its own, ends with it."""
    if path := os.environ.get("TORCHELASTIC_ERROR_FILE"):
        write_json(Path(path), {"message": message, "timestamp": int(time.time())})


def _require_working_directory() -> None:
    try:
        os.getcwd()
    except FileNotFoundError:
        raise UserError("the working directory is gone: change to one that exists") from None


@contextmanager
def standard_streams() -> Iterator[None]:
    """Open standard streams that are closed; end with 141 if the reader of stdout leaves."""
    _prepare_streams()
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        stdout = select.poll()
        stdout.register(sys.stdout.fileno(), 0)
        if not any(event & select.POLLERR for _, event in stdout.poll(0)):
            raise  # not stdout's pipe
        # The rest of the buffer would fail again at the interpreter's end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(128 + signal.SIGPIPE)


def _prepare_streams() -> None:
    """Open streams that were closed at the start; escape what a terminal's encoding lacks."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
