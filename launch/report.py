"""Pack what a bug report needs of a run into one file, report.zip in its folder; nothing is sent anywhere.

It holds the report of `doctor`, the run's options, versions and numbers, the cell file without tokens and
passwords, and of the newest episode the last 10 s: its numbers as a table, its images as sheets.
"""

import csv
import io
import json
import re
import zipfile
from collections.abc import Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Annotated, Any

import tyro

from touchgoal.episodes.schema import Episode, is_image
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import checked_dataclass

_SECONDS = 10.0  # of the newest episode
# the part before @ of token@host:port, and of an address with user:password@host
_SECRET = re.compile(r"[^\s\"'/]+@(?=[\w\[])")


@checked_dataclass
class Config:
    """Options of report."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of the run, such as runs/2026-11-29_10-12-13_deploy."""


def main(config: Config) -> None:
    """Write the file and print what it holds; UserError: no folder of a run."""
    from touchgoal.control.sensors.clip import in_natural_order
    from touchgoal.runtime.atomic_write import atomic_write

    if not (records := in_natural_order(config.run.glob("config*.json"))):
        raise UserError(f"{config.run} is no folder of a run: it has no config.json")
    path, names = config.run / "report.zip", []
    with (
        atomic_write(path) as unfinished,
        zipfile.ZipFile(unfinished, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        for name, content in _contents(config.run, records):
            archive.writestr(name, content)
            names.append(name)
    print(f"{path}: {', '.join(names)}\nlook through it before you attach it to a bug report")


def _contents(run: Path, records: list[Path]) -> Iterator[tuple[str, str | bytes]]:
    """Yield the name and the content of each file."""
    yield "doctor.txt", _doctor()
    for path in [*records, run / "metrics.json"]:
        if path.is_file():
            yield path.name, _SECRET.sub("...@", path.read_text())
    cell = json.loads(records[-1].read_text()).get("config", {}).get("cell")
    if cell:
        yield "cell" + (Path(cell).suffix or ".toml"), _cell(cell)
    yield from _newest_episode(run / "episodes")


def _doctor() -> str:
    from touchgoal.launch import doctor

    with redirect_stdout(io.StringIO()) as text:
        try:
            doctor.main(doctor.Config())
        except UserError as error:
            print(error)
    return text.getvalue()


def _cell(name: str) -> str:
    from touchgoal.control.cell.cell_file import find_cell_file

    try:
        return _SECRET.sub("...@", find_cell_file(Path(name)).read_text())
    except (OSError, UserError) as error:
        return f"{name} cannot be read any more: {error}"


def _newest_episode(root: Path) -> Iterator[tuple[str, str | bytes]]:
    from touchgoal.episodes.store import EpisodeSet
    from touchgoal.rewards.report.thumbnails import Thumbnails

    try:
        episodes = EpisodeSet(root)
        last = len(episodes) - 1
        length = episodes.lengths[last]
        frames = range(max(0, length - round(_SECONDS * episodes.fps)), length)
        end = episodes.read(last, frames=frames)
    except (UserError, IndexError) as error:
        yield "episode.txt", f"no episode: {error}"
        return
    yield "episode.json", json.dumps({"episode": last, "ticks": length, **end.meta}, indent=1)
    yield "ticks.csv", _table(end, episodes.features, frames, episodes.fps)
    thumbnails = Thumbnails(len(frames))
    for _ in thumbnails.collect([end]):
        pass
    for name, sheet in thumbnails.sheets().items():
        yield f"{name}.jpg", sheet.tobytes()


def _table(end: Episode, features: dict[str, Any], frames: range, fps: float) -> str:
    """Return the numbers of some frames as CSV: the time from the start (s), then a column a component."""
    columns = {"seconds": [f"{i / fps:.3f}" for i in frames]}
    for key, values in end.frames.items():
        if not is_image(key):
            rows = values.reshape(len(frames), -1).T
            names = features[key].get("names") or range(len(rows))
            columns |= {f"{key}.{n}": row.tolist() for n, row in zip(names, rows, strict=True)}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return text.getvalue()
