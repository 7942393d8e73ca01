"""Sources of a training without labels: episode sets, published recordings, videos, or several."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from touchgoal.encoders.ssl.frames import (
    Recording,
    TouchFrames,
    find_sensor_name,
    sample_frames,
    sample_recordings,
)
from touchgoal.episodes.importers.labelled_videos import has_labels
from touchgoal.episodes.importers.pretraining_clips import read_recordings
from touchgoal.episodes.importers.video_recordings import read_video_recordings
from touchgoal.episodes.overlap import require_no_shared_frames, require_no_shared_recordings
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.provenance import provenance

Offsets = tuple[int, ...] | None
Draw = Callable[[int, int, Offsets], TouchFrames]
"""Draws a number of samples from each episode or recording by a seed; see `sample_frames`."""


@dataclass(frozen=True)
class UnlabelledTouch:
    """Touches for training and validation."""

    train: Draw  # draws training touches
    validation: Draw  # draws validation touches
    recipe: dict[str, Any]  # JSON-able provenance


@dataclass(frozen=True)
class _Source:
    """A folder: an episode set, or recordings."""

    folder: Path
    sensor: str
    episodes: EpisodeSet | None
    recordings: Sequence[Recording] = ()

    @property
    def training(self) -> list[Recording]:
        return [recording for recording in self.recordings if not recording.held_out]

    @property
    def held_out(self) -> list[Recording]:
        return [recording for recording in self.recordings if recording.held_out]

    @property
    def record(self) -> dict[str, Any]:
        path = str(self.folder)
        if (episodes := self.episodes) is not None:
            return {"path": path, "episodes": len(episodes), "checksum": episodes.checksum}
        return {
            "path": path,
            "recordings": len(self.training),
            "held_out": len(self.held_out),
        }

    def draw(self, recordings: Sequence[Recording]) -> Draw:
        """Return a function that draws from the episode set, or else from these recordings."""
        if (episodes := self.episodes) is not None:
            return lambda count, seed, offsets: sample_frames(
                episodes, self.sensor, count, seed, offsets
            )
        return lambda count, seed, offsets: sample_recordings(recordings, count, seed, offsets)


def open_touch(
    data: Sequence[Path], validation: Sequence[Path], sensor: str | None
) -> UnlabelledTouch:
    """Open folders of one sensor.

    Recordings that a folder of `data` holds out are added to the validation data.

    UserError: no such folder, an unknown or another sensor, nothing to validate on, or frames both
    in the training and in the validation data.
    """
    training_folders = {folder.resolve() for folder in data}
    for folder in validation:
        if folder.resolve() in training_folders:
            raise UserError(
                f"--data and --validation are both {folder}: validate on episodes that are not trained "
                "on; where a folder holds recordings out, leave --validation out"
            )
    first = _open(data[0], sensor)
    train = [first, *(_open(folder, first.sensor) for folder in data[1:])]
    other = [_open(folder, first.sensor) for folder in validation]
    for source in train:
        if not other and not source.held_out:
            raise UserError(
                f"{source.folder} holds no recordings out: name other episodes with --validation"
            )
    _require_no_overlap(train, other)
    return UnlabelledTouch(
        _join([source.draw(source.training) for source in train]),
        _join(
            [source.draw(source.held_out) for source in train if source.held_out]
            + [source.draw(source.recordings) for source in other]
        ),
        {
            **provenance(),
            "data": {
                "train": [source.record for source in train],
                "validation": [source.record for source in other],
            },
        },
    )


def _require_no_overlap(train: Sequence[_Source], other: Sequence[_Source]) -> None:
    for one in train:
        for two in other:
            if one.episodes is not None and two.episodes is not None:
                require_no_shared_frames(one.episodes, two.episodes)
    require_no_shared_recordings(
        [recording for source in train for recording in source.training],
        [recording for source in train for recording in source.held_out]
        + [recording for source in other for recording in source.recordings],
    )


def _open(folder: Path, sensor: str | None) -> _Source:
    if (folder / "meta").exists():
        episodes = EpisodeSet(folder)
        return _Source(folder, find_sensor_name(sensor, episodes), episodes)
    found = read_video_recordings(folder) if has_labels(folder) else read_recordings(folder, sensor)
    recorded = found[0].sensor
    if sensor not in (None, recorded):
        raise UserError(f"{folder} was recorded with {recorded}, not {sensor}")
    return _Source(folder, recorded, None, found)


def _join(draws: list[Draw]) -> Draw:
    return lambda count, seed, offsets: TouchFrames.joined(
        [draw(count, seed, offsets) for draw in draws]
    )
