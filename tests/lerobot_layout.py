"""Sets in lerobot's published layout (v3.0), as `LeRobotDataset` writes them: all episodes in one file."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from touchgoal.episodes.format import set_files
from touchgoal.episodes.media import write_video
from touchgoal.runtime.json_file import write_json

Frames = dict[str, np.ndarray]


def write_lerobot_set(root: Path, episodes: list[Frames], fps: int = 15) -> None:
    """Write episodes; arrays (n, h, w, 3) become videos, others columns. `timestamp` may be given.

    Videos may be longer than the columns.
    """
    videos = [key for key, values in episodes[0].items() if values.ndim == 4]
    lengths = [len(frames["action"]) for frames in episodes]
    ends, ends_shown = np.cumsum(lengths), np.cumsum([len(e[videos[0]]) for e in episodes])
    tables = []
    for i, frames in enumerate(episodes):
        n = lengths[i]
        index = {
            "timestamp": (np.arange(n) / fps).astype(np.float32),
            "frame_index": np.arange(n),
            "episode_index": np.full(n, i),
            "index": np.arange(ends[i] - n, ends[i]),
            "task_index": np.zeros(n, int),
        }
        numbers = {k: v for k, v in frames.items() if k not in videos}
        columns = {"subtask": pa.array(["reach"] * n)}
        for key, values in (index | numbers).items():
            columns[key] = pa.array(values if values.ndim == 1 else list(values))
        tables.append(pa.table(columns))
    (root / "data/chunk-000").mkdir(parents=True)
    pq.write_table(pa.concat_tables(tables), root / set_files.data_path(0))
    for key in videos:
        write_video(
            root / set_files.video_path(key, 0), np.concatenate([e[key] for e in episodes]), fps
        )
    times = np.stack([np.append(0, ends_shown[:-1]), ends_shown], 1) / fps
    rows = [
        _row(i, lengths[i], int(ends[i]), videos, times[i].tolist()) for i in range(len(episodes))
    ]
    for file, part in enumerate((rows[:1], rows[1:])):  # as after `resume`
        path = root / set_files.EPISODES.replace("file-000", f"file-00{file}")
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.Table.from_pylist(part), path)
    described = {key: _feature(values) for key, values in episodes[0].items()}
    described["subtask"] = {"dtype": "string", "shape": [1], "names": None}
    totals = {"episodes": len(episodes), "frames": int(ends[-1]), "tasks": 1}
    info = {"codebase_version": "v3.0", "fps": fps, "features": described}
    write_json(root / set_files.INFO, info | {f"total_{name}": n for name, n in totals.items()})


def _row(i: int, length: int, end: int, videos: list[str], shown: list[float]) -> dict:
    places = {"chunk_index": 0, "file_index": 0}
    row = {
        "episode_index": i,
        "tasks": ["pick up the ball"],
        "length": length,
        "dataset_from_index": end - length,
        "dataset_to_index": end,
        **{f"data/{name}": value for name, value in places.items()},
    }
    times = dict(zip(("from_timestamp", "to_timestamp"), shown, strict=True))
    for key in videos:
        row |= {f"videos/{key}/{name}": value for name, value in (places | times).items()}
    return row


def _feature(values: np.ndarray) -> dict:
    shape = list(values.shape[1:]) or [1]
    dtype = "video" if values.ndim == 4 else str(values.dtype)
    return {"dtype": dtype, "shape": shape, "names": None}


def toy_frames(seed: int, n: int = 24) -> Frames:
    """An arm of six joints with a camera and two fingertips, all as videos."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:32, :48]
    moving = 20 + 4 * np.arange(n)[:, None, None] + columns + rows
    image = np.stack([moving, moving // 2, np.full_like(moving, 20 * seed)], -1).astype(np.uint8)
    return {
        "observation.images.top": image,
        "observation.images.gelsight_left": image[:, ::-1],
        "observation.images.gelsight_right": image[:, :, ::-1],
        "observation.state": rng.normal(size=(n, 6)).astype(np.float32),
        "action": rng.normal(size=(n, 6)).astype(np.float64),
    }
