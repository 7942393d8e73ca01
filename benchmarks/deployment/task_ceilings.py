"""Force and indentation of demonstrations, and the ceilings that follow for deployments."""

from dataclasses import field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.options import BenchmarkOptions
from touchgoal.control import features as ft
from touchgoal.control.safety.limits import TaskForces
from touchgoal.control.tactile.indentation import IndentationMeter
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.episodes.recording import CORRECTED
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies.training.training_data import succeeded
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import checked_dataclass
from touchgoal.runtime.progress import track


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark task-ceilings."""

    data: Path = field(kw_only=True)
    """Folder of an expert's or a person's episodes; the gel's ceiling needs tactile images."""


def peak_force(episode: Episode) -> float:
    """Return the largest force on the hand, N."""
    return float(np.linalg.norm(episode.frames[ft.WRENCH][:, :3], axis=1).max())


def peak_indentation(episode: Episode, sensor: str) -> float:
    """Return the deepest indentation of either gel, m, as read in a deployment; 0 without images."""
    peaks = [0.0]
    for key in set(ft.TACTILE) & set(episode.frames):
        pictures = episode.frames[key]
        meter = IndentationMeter(find_sensor(sensor), pictures[0])
        peaks += [meter.measure(picture) for picture in pictures[1:]]
    return max(peaks)


def run(config: Config) -> dict[str, Any]:
    """Read every successful episode of a set."""
    episodes = EpisodeSet(config.data)
    metas = enumerate(map(episodes.meta, range(len(episodes))))
    good = [i for i, meta in metas if succeeded(meta) and meta.get("outcome") != CORRECTED]
    if not good:
        raise UserError(f"no episode of {config.data} says that it succeeded")
    sensor = str(episodes.meta(good[0])["sensor"])
    peaks: Float[np.ndarray, "k 2"] = np.array([
        (peak_force(episode), peak_indentation(episode, sensor))
        for episode in (episodes.read(i) for i in track(good, "reading", "episode"))
    ])  # fmt: skip
    reached = TaskForces(float(peaks[:, 0].max()), float(peaks[:, 1].max()), len(good))
    ceilings = {
        "safety.force": (reached.force_ceiling, "N"),
        "safety.torque": (reached.torque_ceiling, "Nm"),
        "safety.indentation": (reached.indentation_ceiling, "m"),
    }
    lines = [f"{'of an episode, at most':<24}{'median':>10}{'99 %':>10}{'highest':>10}"]
    for name, values in (("force N", peaks[:, 0]), ("indentation mm", 1e3 * peaks[:, 1])):
        cells = (f"{np.quantile(values, q):>10.2f}" for q in (0.5, 0.99, 1.0))
        lines.append(f"{name:<24}{''.join(cells)}")
    proposed = ", ".join(f"{name} {value:.3g} {unit}" for name, (value, unit) in ceilings.items())
    lines.append(f"ceilings that follow from {len(good)} successful episodes: {proposed}")
    return {
        "peaks": peaks.tolist(),
        "sensor": sensor,
        "ceilings": {name: value for name, (value, _) in ceilings.items()},
        "table": "\n".join(lines),
    }
