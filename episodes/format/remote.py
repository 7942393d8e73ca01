"""Sets on a remote file system, such as s3://bucket/set or hf://datasets/owner/set, for reading.

A remote set is read through its mirror, a folder in the cache. Opening it lists the remote files and fetches
those under meta/; any other file is fetched when it is first read. On a disk that is nearly full the files
fetched first are deleted, so a set may be larger than the disk. The clients are pyarrow's (s3, gs, hf);
fsspec+NAME:// opens any other file system of fsspec.
"""

import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from functools import cache
from glob import glob
from pathlib import Path
from tempfile import TemporaryDirectory

from pyarrow import fs

from touchgoal.control.sensors.clip import in_natural_order
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.json_file import parse_json, write_json

_URL = re.compile(r"([a-z][a-z0-9+]+):/{1,2}([^/].*?)/*")  # a Path drops one of the slashes
_INFO = "meta/info.json"
_TREES = ("meta", "data", "videos")
_LISTING = ".remote.json"  # address of a mirror's set, and its files
_SPARE = 1 << 30  # bytes left free on the disk


def local_folder(path: Path) -> Path:
    """Return the folder of a set; for a remote set that of its mirror, brought up to date.

    UserError: no such place, no set there, no access or no network.
    """
    url = _address(path)
    if url is None:
        return path
    with _one_line_errors(url):
        filesystem, base = _open(url)
        found = filesystem.get_file_info(fs.FileSelector(base, recursive=True))
    files = {f.path.removeprefix(f"{base}/"): f for f in found if f.is_file}
    if _INFO not in files and f"episodes/{_INFO}" in files:
        return local_folder(Path(f"{url}/episodes"))  # the folder of a run
    if _INFO not in files:
        raise UserError(f"{url} is not a set of episodes (it has no {_INFO}): check the address")
    root = cache_folder() / url.replace("://", "/")
    _delete_outdated(root, files)
    for name in files:
        if name.startswith("meta/") and ".." not in name and not (root / name).exists():
            _fetch(url, name, root)
    write_json(root / _LISTING, {"url": url, "files": sorted(files)})
    return root


def is_pattern(path: Path) -> bool:
    """Return whether a path or an address stands for several folders, such as runs/large/*."""
    return "*" in str(path) and not path.exists()


def matching_folders(path: Path) -> list[Path]:
    """Return the folders, or addresses, that a pattern matches; any other path as it is.

    They are in the order of their names, with numbers as numbers; a run stands for its `episodes/`.
    UserError: there is none.
    """
    if not is_pattern(path):
        return [path]
    if url := _address(path):
        base, _, last = url[: url.index("*")].rpartition("/")
        found = [base]
        for part in f"{last}{url[url.index('*') :]}".split("/"):
            found = [
                f"{u}/{name}" for u in found for name in _folders_in(u) if fnmatchcase(name, part)
            ]
    else:
        found = [name for name in glob(str(path)) if Path(name).is_dir()]
    if not found:
        raise UserError(f"{path} matches no folder: check the pattern, and the quotes around it")
    folders = in_natural_order(map(Path, found))
    return [run if (run := folder / "episodes").is_dir() else folder for folder in folders]


def _folders_in(url: str) -> list[str]:
    with _one_line_errors(url):
        filesystem, base = _open(url)
        found = filesystem.get_file_info(fs.FileSelector(base))
    return [f.base_name for f in found if f.type == fs.FileType.Directory]


def fetched(root: Path, name: str) -> Path:
    """Return a file of the set in `root`, after fetching it if that is a mirror without it."""
    path = root / name
    if not path.exists() and (listing := _listing(root)):
        _fetch(listing["url"], name, root)
    return path


def first_missing(root: Path, names: Iterable[str]) -> str | None:
    """Return the first file that neither the set in `root` nor the remote one that it mirrors has.

    Names are quickest sorted by folder: each folder is listed once, not each file looked for.
    """
    mirrored, listed, there = _listing(root).get("files", ()), None, set()
    for name in names:
        folder, _, file = name.rpartition("/")
        if folder != listed:
            listed, there = folder, _files_in(root / folder)
        if file not in there and name not in mirrored:
            return name
    return None


def _files_in(folder: Path) -> set[str]:
    if not folder.is_dir():
        return set()
    with os.scandir(folder) as entries:
        return {entry.name for entry in entries if entry.is_file()}


def check_local(root: Path) -> None:
    """Raise UserError if episodes were to be written to a remote set or into a mirror."""
    if url := _address(root) or _listing(root).get("url"):
        raise UserError(f"{url} is only read: record into a local folder, and copy it there")


def _address(path: Path) -> str | None:
    match = _URL.fullmatch(str(path))
    return "://".join(match.groups()) if match and ".." not in path.parts else None


def cache_folder() -> Path:
    """Return the user's folder for what can be made or fetched again."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "touchgoal"


def _listing(root: Path) -> dict:
    """Return what a mirror's listing holds; {} for any other folder."""
    path = root / _LISTING
    return _read_listing(path, path.stat().st_mtime_ns) if path.exists() else {}


@cache
def _read_listing(path: Path, modified: int) -> dict:
    listing = parse_json(path.read_bytes())
    return {**listing, "files": frozenset(listing["files"])}


@cache
def _open(url: str) -> tuple[fs.FileSystem, str]:
    filesystem, base = fs.FileSystem.from_uri(url)
    return filesystem, base.rstrip("/")


def _delete_outdated(root: Path, files: dict[str, fs.FileInfo]) -> None:
    """Delete a mirror's files that are gone or differ in size or time; without times all of meta/."""
    for path in [p for tree in _TREES for p in (root / tree).rglob("*") if p.is_file()]:
        name = path.relative_to(root).as_posix()
        there, here = files.get(name), path.stat()
        same = there and (here.st_size, int(here.st_mtime)) == (there.size, _seconds(there))
        if not (there and same) or (there.mtime is None and name.startswith("meta/")):
            path.unlink(missing_ok=True)


def _seconds(there: fs.FileInfo) -> int:
    """Return a remote file's time in whole seconds, as HTTP has it; 0 if the client gives none."""
    return (there.mtime_ns or 0) // 10**9


def _fetch(url: str, name: str, root: Path) -> None:
    """Fetch a file into a mirror, whole or not at all, with the time of the remote file."""
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    with _one_line_errors(f"{url}/{name}"), TemporaryDirectory(dir=root, prefix=".fetch_") as part:
        filesystem, base = _open(url)
        there = filesystem.get_file_info(f"{base}/{name}")
        if not there.is_file:
            raise FileNotFoundError
        _make_room(root, there.size)
        unfinished = Path(part) / path.name
        fs.copy_files(there.path, str(unfinished), filesystem, fs.LocalFileSystem())
        os.utime(unfinished, (0, _seconds(there)))
        os.replace(unfinished, path)


def _make_room(root: Path, size: int) -> None:
    """Delete files of episodes, earliest fetched first, until `size` bytes and a reserve are free."""
    if shutil.disk_usage(root).free >= size + _SPARE:
        return
    files = [p for tree in ("data", "videos") for p in (root / tree).rglob("*") if p.is_file()]
    files.sort(key=lambda p: p.stat().st_ctime_ns)
    while files and shutil.disk_usage(root).free < size + _SPARE:
        files.pop(0).unlink(missing_ok=True)


@contextmanager
def _one_line_errors(url: str) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError as error:
        raise UserError(f"{url} does not exist: check the address") from error
    except Exception as error:  # a client raises whatever its parts raise
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise UserError(
            f"cannot read {url} ({reason}): check the address, the network and the credentials"
        ) from error
