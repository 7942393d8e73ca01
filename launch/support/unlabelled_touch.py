"""What trainings without labels learn from: episodes, or published recordings."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from touchgoal.control.errors import UserError
from touchgoal.control.provenance import provenance
from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.encoders.ssl.frames import TouchFrames, check_sensor, sample_frames
from touchgoal.encoders.ssl.published_frames import sample_recordings
from touchgoal.episodes.importers.pretraining_clips import is_published, read_recordings
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch.support.training_run import open_sets, recipe

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


def open_touch(data: Path, validation: Path | None, sensor: str | None) -> UnlabelledTouch:
    """Opens what was named, and checks its sensor.

    Raises:
        UserError: no such folder, an unknown or another sensor, or nothing to judge by.
    """
    if is_published(data) or (validation is None and not (data / "meta").exists()):
        return _published(data, validation, sensor)
    if validation is None:
        raise UserError(
            f"{data} is no published folder that holds recordings out: name other episodes with "
            "--validation"
        )
    sets = open_sets(data, validation)
    named = sensor_of(sensor, *sets)
    train, val = (
        lambda count, seed, offsets, episodes=episodes: sample_frames(
            episodes, named, count, seed, offsets
        )
        for episodes in sets
    )
    return UnlabelledTouch(train, val, recipe(*sets))


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


def _published(data: Path, validation: Path | None, sensor: str | None) -> UnlabelledTouch:
    found = read_recordings(data, sensor)
    if validation is None:
        learned = [recording for recording in found if not recording.held_out]
        judged = [recording for recording in found if recording.held_out]
    elif validation.resolve() == data.resolve():
        raise UserError(f"--data and --validation are both {data}: leave --validation out")
    else:
        learned, judged = found, read_recordings(validation, found[0].clip.sensor)
    train, val = (
        lambda count, seed, offsets, chosen=chosen: sample_recordings(chosen, count, seed, offsets)
        for chosen in (learned, judged)
    )
    paths = {"train": str(data), "validation": str(validation or data)}
    facts = {"recordings": len(learned), "validation_recordings": len(judged), "data": paths}
    return UnlabelledTouch(train, val, {**provenance(), **facts})
