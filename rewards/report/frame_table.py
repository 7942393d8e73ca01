"""All values of all frames in one Parquet table, in the layouts that LeRobot reads.

`frames.parquet` is a table of frame signals: index, episode_index, frame_index and one column per
signal, described in the schema's metadata. `touchgoal_progress.parquet` has the column that LeRobot's
reward-weighted training and its overlay videos read, `progress_sparse`.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from touchgoal.rewards.curves import main_curve
from touchgoal.rewards.report.record import COST, POTENTIAL, RAW, REWARD, Facts, Record
from touchgoal.runtime.atomic_write import atomic_write

FRAMES, PROGRESS = "frames.parquet", "touchgoal_progress.parquet"
_METADATA = "lerobot.reward_scoring."  # LeRobot's rewards/scoring, format version 1
_INDEX = [pa.field(k, pa.int64(), False) for k in ("index", "episode_index", "frame_index")]
_TIME, _NEXT_REWARD, _PROGRESS = "timestamp", "next.reward", "progress_sparse"
_MEANING = {  # beginning of a column's name -> meaning, and whether higher or lower is better
    COST: ("distance to the goal, 0 at the goal", "lower"),
    REWARD: ("-cost", "higher"),
    POTENTIAL: ("potential-based reward of the step into the frame", "higher"),
    RAW: ("cosine distance of the embeddings to the goal's", "lower"),
}


def write_frames(
    paths: Sequence[Path], facts: Sequence[Facts], out: Path, provenance: Mapping[str, Any]
) -> None:
    """Write `frames.parquet` from the records at `paths`, one after the other.

    `next.reward` is the potential-based reward of the step from a frame to the next one, of the main
    curve; 0 at the last frame. A value that a trajectory lacks is NaN.
    """
    names = list(dict.fromkeys(name for one in facts for name in one.columns))
    signals = [_TIME, *map(_signal, names), _NEXT_REWARD]
    fields = [*_INDEX, *(pa.field(name, pa.float32(), False) for name in signals)]
    metadata = {
        "format": "lerobot.frame_signals",
        "schema_version": 1,
        "provenance": dict(provenance),
        "descriptors": {name: _describe(name, facts[0]) for name in signals},
        "episode_indices": [one.index for one in facts],
    }
    canonical = partial(json.dumps, sort_keys=True, separators=(",", ":"))
    schema = pa.schema(fields, {f"{_METADATA}{k}": canonical(v) for k, v in metadata.items()})
    _write(out / FRAMES, schema, (_rows(Record.load(path), names) for path in paths))


def write_progress(paths: Sequence[Path], out: Path) -> None:
    """Write `touchgoal_progress.parquet` from normalised records: 1 - cost of the main curve."""
    schema = pa.schema([*_INDEX, pa.field(_PROGRESS, pa.float32(), False)])
    _write(out / PROGRESS, schema, (_rows(Record.load(path), ()) for path in paths))


def _write(path: Path, schema: pa.Schema, tables: Iterator[dict[str, np.ndarray]]) -> None:
    with atomic_write(path) as unfinished, pq.ParquetWriter(unfinished, schema) as writer:
        for columns in tables:
            writer.write_table(pa.Table.from_pydict(columns, schema))


def _rows(record: Record, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return all columns of a trajectory."""
    facts, columns = record.facts, record.columns
    frames, missing = np.arange(facts.frames), np.full(facts.frames, np.nan)
    main = main_curve(record.costs)
    index = facts.offset + frames, np.full(facts.frames, facts.index), frames
    return {
        **dict(zip((field.name for field in _INDEX), index, strict=True)),
        _TIME: frames / facts.fps,
        **{_signal(name): columns.get(name, missing) for name in names},
        _NEXT_REWARD: np.append(columns[f"{POTENTIAL}{main}"][1:], 0.0),
        _PROGRESS: np.clip(1 - record.costs[main], 0, 1),
    }


def _signal(column: str) -> str:
    """Return a column's name with letters, digits and underscores alone."""
    return re.sub(r"\W+", "_", column)


def _describe(signal: str, facts: Facts) -> dict[str, Any]:
    if signal == _TIME:
        meaning, direction, unit = "time since the first frame", "none", "s"
    elif signal == _NEXT_REWARD:
        meaning, direction, unit = "reward of the step to the next frame", "higher", facts.unit
    else:
        kind = next(prefix for prefix in _MEANING if signal.startswith(prefix))
        meaning, direction = _MEANING[kind]
        unit = "cosine distance" if kind == RAW else facts.unit
        meaning = f"{signal.removeprefix(kind)}: {meaning}"
    return {
        "description": meaning,
        "direction": direction,
        "bounds": [None, None],
        "unit": unit,
        "comparison_scope": "dataset" if facts.normalised else "episode",
        "allow_nan": direction != "none",
    }
