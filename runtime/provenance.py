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

from touchgoal import __version__

_PROGRAM = "touchgoal"
_PACKAGES = ("numpy", "torch", "mujoco", "opencv-contrib-python-headless")


def command_line() -> str:
    """Return the running command as it can be typed again."""
    return shlex.join([_PROGRAM, *sys.argv[1:]])


def portable(record: Any, project: Path | None = None) -> Any:
    """Return a JSON-able record without folders of this machine.

    Absolute paths, also those in commands, become relative to the project, or lose their folders if
    they lie elsewhere.

    Args:
        record: Strings, paths, and containers of them.
        project: Folder that paths become relative to; default: the working directory.
    """
    project = project or Path.cwd()
    match record:
        case dict():
            return {key: portable(value, project) for key, value in record.items()}
        case list() | tuple():
            return [portable(value, project) for value in record]
        case Path():
            return portable(str(record), project)
        case str() if record.startswith(f"{_PROGRAM} "):
            return shlex.join(_portable_path(word, project) for word in shlex.split(record))
        case str():
            return _portable_path(record, project)
        case _:
            return record


def _portable_path(text: str, project: Path) -> str:
    """Shorten an absolute path, or the one after an option's `=`."""
    option, equals, value = text.rpartition("=") if text.startswith("-") else ("", "", text)
    path = Path(value)
    if not path.is_absolute():
        return text
    shorter = path.relative_to(project) if path.is_relative_to(project) else Path(path.name)
    return f"{option}{equals}{shorter}"


def provenance() -> dict[str, Any]:
    """Return what every checkpoint and every folder of results records beside its numbers.

    Returns:
        `command`, without folders of this machine; `commit` and `dirty` (whether files differ from
        it), None for an installed package; version `touchgoal`; `date`, local time.
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
    folder = Path(__file__).resolve().parent
    try:
        answer = subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, text=True
        )
    except OSError:
        return None
    return answer.stdout.strip() if answer.returncode == 0 else None
