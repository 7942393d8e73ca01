"""Recordings in HDF5: robomimic's files (`data/demo_0/obs/...`), and one episode a file (ALOHA and others).

A data set is a stream if it has a row for every step; robomimic's file tells the rate in `env_args`, of
other files the user tells it. Streams are called as the data sets, without `obs/` or `observations/`.
"""

import json
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from touchgoal.episodes.importers.streams import RawEpisode, Stream
from touchgoal.runtime.errors import UserError, install_extra


def find_episodes(path: Path, fps: float | None) -> list[Callable[[], RawEpisode]]:
    """Return what reads each episode of a file, in natural order; `fps` if the file does not tell its rate.

    UserError: no HDF5, or no rate.
    """
    with _open(path) as file:
        env = json.loads(file["data"].attrs.get("env_args", "{}")) if "data" in file else {}
        about = env.get("env_kwargs", {})
        rate = about.get("control_freq") or fps
        if not rate:
            raise UserError(f"{path} does not tell its rate: add --fps")
        names = [f"data/{name}" for name in file["data"]] if "data" in file else ["/"]
    names.sort(key=lambda name: [int(n) for n in re.findall(r"\d+", name)])
    sparse = bool(env) and not about.get("reward_shaping")
    return [partial(_recording, path, name, rate, sparse) for name in names]


def _recording(path: Path, group: str, rate: float, sparse: bool) -> RawEpisode:
    """Read an episode; with a `sparse` reward, one above 0 is a success. UserError: no data."""
    sizes: dict[str, tuple[int, ...]] = {}

    def visit(name: str, item: Any) -> None:
        if hasattr(item, "shape") and item.dtype.kind in "fiub" and item.shape:
            sizes[name] = item.shape

    with _open(path) as file:
        file[group].visititems(visit)
        steps = [size[0] for size in sizes.values()]
        n = max(set(steps), key=steps.count, default=0)
        rewards = file[group]["rewards"][:] if sparse and "rewards" in file[group] else None
    if n < 2:
        raise UserError(f"{path} has no episode in {group}")
    streams = {}
    for name, (length, *shape) in sizes.items():
        short = re.sub(r"^(obs|observations)/(images/)?", "", name)
        if length == n and not name.startswith("next_obs/") and _is_read(shape):
            streams[short] = Stream(
                np.arange(n) / rate,
                tuple(shape or [1]),
                lambda rows, name=f"{group}/{name}": _rows(path, name, rows),
            )
    success = None if rewards is None else bool((rewards > 0).any())  # a sparse reward
    of_file = path.stem if group == "/" else f"{path.stem}/{group.removeprefix('data/')}"
    return RawEpisode(of_file, streams, success)


def _is_read(shape: list[int]) -> bool:
    return len(shape) < 2 or (len(shape) == 3 and shape[2] == 3)


def _rows(path: Path, name: str, rows: np.ndarray) -> np.ndarray:
    with _open(path) as file:
        values = file[name][int(rows.min()) : int(rows.max()) + 1][rows - rows.min()]
    return values if values.ndim > 1 else values[:, None]


def _open(path: Path) -> Any:
    try:
        import h5py
    except ImportError:
        raise UserError(f"{path.name} needs {install_extra('import')}") from None
    try:
        return h5py.File(path)
    except OSError as error:
        raise UserError(f"{path} is no HDF5 file: {error}") from None
