"""Measured trajectories for the rerun viewer: cameras, fingertips and curves on one timeline."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from touchgoal.control.features import IMAGE_PREFIX
from touchgoal.episodes.schema import is_image
from touchgoal.rewards.report.record import COST, POTENTIAL, Record
from touchgoal.rewards.sources.trajectory import Trajectory
from touchgoal.runtime.viewer.stream import RerunStream, open_rerun


def write_recording(
    target: str, trajectories: Sequence[Trajectory], records: Iterable[Path]
) -> None:
    """Show the trajectories that have a record in rerun; their pictures are read once more.

    Each trajectory has a tab and begins at time 0. UserError as `open_rerun`, or a file of a trajectory
    is missing or unreadable.
    """
    by_name = {t.name: t for t in trajectories}
    with open_rerun(target) as stream:
        shown = [r for r in map(Record.load, records) if r.facts.name in by_name]
        images = [f"{r.facts.name}/{image}" for r in shown for image in r.sheets]
        stream.show(images, [path for r in shown for path in _curves(r)], "time")
        for record in shown:
            _log(stream, by_name[record.facts.name], _curves(record))


def _curves(record: Record) -> dict[str, Float[np.ndarray, " n"]]:
    return {
        f"{record.facts.name}/{plot}/{column.removeprefix(kind)}": values
        for kind, plot in ((COST, "cost"), (POTENTIAL, "potential reward"))
        for column, values in record.columns.items()
        if column.startswith(kind)
    }


def _log(
    stream: RerunStream, trajectory: Trajectory, curves: Mapping[str, Float[np.ndarray, " n"]]
) -> None:
    frame = 0
    for chunk in trajectory.chunks():
        images = {
            f"{trajectory.name}/{key.removeprefix(IMAGE_PREFIX)}": values
            for key, values in chunk.frames.items()
            if is_image(key)
        }
        for i in range(len(chunk)):
            pictures = {path: values[i] for path, values in images.items()}
            scalars = {path: values[frame] for path, values in curves.items()}
            stream.log(frame, frame / trajectory.fps, pictures, scalars)
            frame += 1
