"""Measured trajectories for the rerun viewer: cameras, fingertips and curves on one timeline."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from touchgoal.episodes.schema import is_image
from touchgoal.rewards.report.record import Record
from touchgoal.rewards.sources.trajectory import Trajectory
from touchgoal.runtime.atomic_write import atomic_write
from touchgoal.runtime.errors import UserError, install_extra

_JPEG_QUALITY = 90


def load_rerun() -> Any:
    """Import rerun; UserError if it is not installed."""
    try:
        import rerun  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise UserError(f"--rerun needs rerun-sdk: {install_extra('viz')}") from error
    return rerun


def write_recording(
    path: Path, trajectories: Sequence[Trajectory], records: Iterable[Path]
) -> None:
    """Write an .rrd of the trajectories that have a record; their pictures are read once more.

    Each trajectory has entities under its own name and begins at time 0. UserError: no rerun, or a
    file of a trajectory is missing or unreadable.
    """
    rerun, by_name = load_rerun(), {t.name: t for t in trajectories}
    with atomic_write(path) as unfinished:
        recording = rerun.RecordingStream("touchgoal")
        recording.save(str(unfinished))
        for record in map(Record.load, records):
            if record.facts.name in by_name:
                _log(rerun, recording, by_name[record.facts.name], record)
        recording.disconnect()  # writes the rest


def _log(rerun: Any, recording: Any, trajectory: Trajectory, record: Record) -> None:
    frame, name = 0, trajectory.name
    for chunk in trajectory.chunks():
        images = {key: values for key, values in chunk.frames.items() if is_image(key)}
        for i in range(len(chunk)):
            recording.set_time("frame", sequence=frame)
            recording.set_time("time", duration=frame / trajectory.fps)
            for key, values in images.items():
                image = rerun.Image(np.asarray(values[i])).compress(jpeg_quality=_JPEG_QUALITY)
                recording.log(f"{name}/{key.rpartition('.')[2]}", image)
            for column, values in record.columns.items():
                recording.log(f"{name}/curves/{column}", rerun.Scalars(float(values[frame])))
            frame += 1
