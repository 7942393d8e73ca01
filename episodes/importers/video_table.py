"""A folder with an episode's videos and a CSV table of numbers, whose column `time` counts seconds.

Columns that differ in a last number are the components of one stream: q_0 to q_6 are q. A video begins
with the table and has its own rate.
"""

import csv
import re
from collections import defaultdict
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from touchgoal.control.sensors.clip import VIDEOS, Clip, open_clip
from touchgoal.episodes.importers.streams import RawEpisode, Stream
from touchgoal.runtime.errors import UserError

_TIMES = ("time", "timestamp", "t")


def is_video_table(folder: Path) -> bool:
    """Return whether a folder holds one table and videos."""
    return len(list(folder.glob("*.csv"))) == 1 and bool(_videos(folder))


def read_video_table(folder: Path) -> RawEpisode:
    """Read the table; videos are read when they are asked for.

    UserError: no column of times, or something that is no number.
    """
    table = next(folder.glob("*.csv"))
    with table.open(newline="", encoding="utf-8-sig") as file:
        head, *rows = list(csv.reader(file)) or [[]]
    try:
        values = np.array(rows, float)
    except ValueError as error:
        raise UserError(f"{table}: every cell is a number ({error})") from None
    if (time := next((name for name in _TIMES if name in head), None)) is None or len(rows) < 2:
        raise UserError(f"{table} needs a column {_TIMES[0]}, in seconds, and rows")
    times = values[:, head.index(time)]
    columns: dict[str, list[int]] = defaultdict(list)
    for k, name in enumerate(head):
        if name != time:
            columns[re.sub(r"[._\[]?\d+\]?$", "", name) or name].append(k)
    streams = {
        name: Stream(times, (len(of),), values[:, of].__getitem__, tuple(head[k] for k in of))
        for name, of in columns.items()
    }
    for path in _videos(folder):
        clip = open_clip(path)
        at = times[0] + np.arange(clip.length) / (clip.fps or 1.0)
        streams[path.stem] = Stream(at, (*clip.shape, 3), partial(_frames, clip))
    return RawEpisode(folder.name, streams)


def _videos(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in VIDEOS)


def _frames(clip: Clip, rows: np.ndarray) -> UInt8[np.ndarray, "k h w 3"]:
    wanted = set(rows.tolist())
    read = enumerate(islice(clip.frames(), int(rows.max()) + 1))
    kept = {k: image for k, image in read if k in wanted}
    if missing := wanted - kept.keys():
        raise UserError(f"{clip.path} ends before frame {min(missing)}")
    return np.stack([kept[k] for k in rows.tolist()])
