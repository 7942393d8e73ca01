"""What trainings without labels learn from: episodes, published recordings, videos, or several of these."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.encoders.ssl.frames import (
    Recorded,
    TouchFrames,
    check_sensor,
    sample_frames,
    sample_recordings,
)
from touchgoal.episodes.importers.labelled_videos import has_labels
from touchgoal.episodes.importers.pretraining_clips import read_recordings
from touchgoal.episodes.importers.video_recordings import read_video_recordings
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.provenance import provenance

Offsets = tuple[int, ...] | None
Draw = Callable[[int, int, Offsets], TouchFrames]
"""So many touches of each episode or recording, by a seed; offsets as in `sample_frames`."""


@dataclass(frozen=True)
class UnlabelledTouch:
    """Where touches are drawn from.

    Attributes:
        train: to learn from.
        validation: others, to judge by.
        recipe: JSON-able; where they come from.
    """

    train: Draw
    validation: Draw
    recipe: dict[str, Any]


@dataclass(frozen=True)
class _Source:
    """One folder: all of it, and what it asks not to learn from, if it does."""

    folder: Path
    sensor: str
    whole: Draw
    learned: Draw
    held_out: Draw | None
    facts: dict[str, Any]


def open_touch(
    data: Sequence[Path], validation: Sequence[Path], sensor: str | None
) -> UnlabelledTouch:
    """Opens what was named, all of one sensor.

    What a folder of `data` holds out is judged by, besides `validation`.

    Raises:
        UserError: no such folder, an unknown or another sensor, or nothing to judge by.
    """
    learned_from = {folder.resolve() for folder in data}
    for folder in validation:
        if folder.resolve() in learned_from:
            raise UserError(
                f"--data and --validation are both {folder}: judge by episodes that are not learned "
                "from; where a folder holds recordings out, leave --validation out"
            )
    first = _open(data[0], sensor)
    learned = [first, *(_open(folder, first.sensor) for folder in data[1:])]
    judged = [_open(folder, first.sensor) for folder in validation]
    if not judged:
        for source in learned:
            if source.held_out is None:
                raise UserError(
                    f"{source.folder} holds no recordings out: name other episodes with --validation"
                )
    held_out = [source.held_out for source in learned if source.held_out is not None]
    facts = {
        "train": [source.facts for source in learned],
        "validation": [source.facts for source in judged],
    }
    return UnlabelledTouch(
        _joined([source.learned for source in learned]),
        _joined([*held_out, *(source.whole for source in judged)]),
        {**provenance(), "data": facts},
    )


def sensor_of(named: str | None, *sets: EpisodeSet) -> str:
    """The sensor of all episodes; UserError if it is unknown, or not the one that was named."""
    sensor = named or str(sets[0].meta(0).get("sensor", ""))
    if not sensor:
        raise UserError(f"{sets[0].root} does not name its fingertip sensor: name it with --sensor")
    preprocessor_for(sensor)
    for episodes in sets:
        for i in range(len(episodes)):
            check_sensor(episodes, i, sensor)
    return sensor


def _open(folder: Path, sensor: str | None) -> _Source:
    if (folder / "meta").exists():
        return _episodes(folder, sensor)
    found = read_video_recordings(folder) if has_labels(folder) else read_recordings(folder, sensor)
    recorded = found[0].sensor
    if sensor not in (None, recorded):
        raise UserError(f"{folder} was recorded with {recorded}, not {sensor}")
    kept = [recording for recording in found if not recording.held_out]
    others = [recording for recording in found if recording.held_out]
    facts = {"path": str(folder), "recordings": len(kept), "held_out": len(others)}
    draws = _drawn(found), _drawn(kept), _drawn(others) if others else None
    return _Source(folder, recorded, *draws, facts)


def _episodes(folder: Path, sensor: str | None) -> _Source:
    episodes = EpisodeSet(folder)
    named = sensor_of(sensor, episodes)

    def draw(count: int, seed: int, offsets: Offsets) -> TouchFrames:
        return sample_frames(episodes, named, count, seed, offsets)

    facts = {"path": str(folder), "episodes": len(episodes), "checksum": episodes.checksum}
    return _Source(folder, named, draw, draw, None, facts)


def _drawn(recordings: Sequence[Recorded]) -> Draw:
    return lambda count, seed, offsets: sample_recordings(recordings, count, seed, offsets)


def _joined(draws: list[Draw]) -> Draw:
    return lambda count, seed, offsets: TouchFrames.joined(
        [draw(count, seed, offsets) for draw in draws]
    )
