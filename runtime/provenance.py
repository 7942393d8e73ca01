"""Provenance of results: command, commit, versions, hardware."""

import importlib.metadata
import platform
import shlex
import subprocess
import sys
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

from touchgoal.runtime.version import __version__

_PROGRAMS = ("touchgoal ", "python -m benchmarks ")
_PACKAGES = ("numpy", "torch", "mujoco", "opencv-contrib-python-headless")


def command_line() -> str:
    """Return the running command as it can be typed again."""
    return f"{sys.argv[0]} {shlex.join(sys.argv[1:])}".strip()


def portable(record: Any) -> Any:
    """Return strings, paths, and containers of them without folders of this machine.

    Absolute paths, also those in commands, become relative to the working directory, or lose their
    folders if they lie elsewhere.
    """
    match record:
        case dict():
            return {key: portable(value) for key, value in record.items()}
        case list() | tuple():
            return [portable(value) for value in record]
        case Path():
            return portable(str(record))
        case str() if record.startswith(_PROGRAMS):
            return shlex.join(map(_portable_path, shlex.split(record)))
        case str():
            return _portable_path(record)
        case _:
            return record


def _portable_path(text: str) -> str:
    """Shorten an absolute path, or the one after an option's `=`."""
    option, equals, value = text.rpartition("=") if text.startswith("-") else ("", "", text)
    path, project = Path(value), Path.cwd()
    if not path.is_absolute():
        return text
    shorter = path.relative_to(project) if path.is_relative_to(project) else Path(path.name)
    return f"{option}{equals}{shorter}"


def provenance() -> dict[str, Any]:
    """Return what every checkpoint and every folder of results records beside its numbers.

    `dirty` tells whether files differ from `commit`; both are None for an installed package. The
    command contains no folders of this machine; the date is local time.
    """
    commit, dirty = _commit()
    return {
        "command": portable(command_line()),
        "touchgoal": __version__,
        "commit": commit,
        "dirty": dirty,
        "date": f"{datetime.now():%Y-%m-%d %H:%M:%S}",
    }


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that results depend on most."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def hardware() -> str:
    """Return the processor of this machine, and its GPU if torch is imported and has one."""
    torch = sys.modules.get("torch")
    gpu = torch.cuda.get_device_name() if torch is not None and torch.cuda.is_available() else ""
    return ", ".join(filter(None, (_processor(), gpu)))


def _processor() -> str:
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return model
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{len(names)} cores, {names[0]}" if names else model


@cache
def _commit() -> tuple[str | None, bool | None]:
    """Return a checkout's commit and whether its files differ; (None, None) for an installed package."""
    here = Path(__file__).resolve()
    # An installed package may lie in another repository, which does not track this file.
    if _git("ls-files", "--error-unmatch", here.name) is None:
        return None, None
    return _git("rev-parse", "HEAD"), bool(_git("status", "--porcelain", "--untracked-files=no"))


def _git(*arguments: str) -> str | None:
    """Return git's output; None if it fails or is missing."""
    command = ["git", "-C", str(Path(__file__).resolve().parent), *arguments]
    try:
        return subprocess.check_output(command, stderr=subprocess.DEVNULL, text=True).strip()
    except (OSError, subprocess.CalledProcessError):
        return None
