"""Sources of a training without labels: episode sets, published recordings, videos, or several."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from touchgoal.encoders.ssl import frames
from touchgoal.episodes.format.joined import load_episodes
from touchgoal.episodes.format.remote import is_pattern, local_folder
from touchgoal.episodes.importers.labelled_videos import has_labels, read_labelled_videos
from touchgoal.episodes.importers.pretraining_clips import read_recordings
from touchgoal.episodes.overlap import require_disjoint, require_no_shared_frames
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.provenance import provenance

Draw = Callable[[int, int, tuple[int, ...]], frames.TouchFrames]
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
    recordings: Sequence[frames.Recording] = ()

    def chosen(self, held_out: bool) -> list[frames.Recording]:
        """Return the recordings for training, or those that are held out of it."""
        return [recording for recording in self.recordings if recording.held_out == held_out]

    def record(self) -> dict[str, Any]:
        """Return the source's part of the provenance."""
        path = str(self.folder)
        if (episodes := self.episodes) is not None:
            return {"path": path, "episodes": len(episodes), "checksum": episodes.checksum}
        trained, held_out = (len(self.chosen(held_out)) for held_out in (False, True))
        return {"path": path, "recordings": trained, "held_out": held_out}

    def draw(self, recordings: Sequence[frames.Recording]) -> Draw:
        """Return a function that draws from the episode set, or else from these recordings."""
        if (episodes := self.episodes) is not None:
            return partial(frames.sample_frames, episodes, self.sensor)
        return partial(frames.sample_recordings, recordings)


def open_touch(
    data: Sequence[Path],
    validation: Sequence[Path],
    sensor: str | None,
    keys: Mapping[str, str] | None = None,
) -> UnlabelledTouch:
    """Open folders of one sensor; `keys`, for episode sets, as for `EpisodeSet`.

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
    first = _open(data[0], sensor, keys)
    train = [first, *(_open(folder, first.sensor, keys) for folder in data[1:])]
    other = [_open(folder, first.sensor, keys) for folder in validation]
    for source in train:
        if not other and not source.chosen(held_out=True):
            raise UserError(
                f"{source.folder} holds no recordings out: name other episodes with --validation"
            )
    _require_no_overlap(train, other)
    return UnlabelledTouch(
        _join([source.draw(source.chosen(held_out=False)) for source in train]),
        _join(
            [source.draw(held) for source in train if (held := source.chosen(held_out=True))]
            + [source.draw(source.recordings) for source in other]
        ),
        {
            **provenance(),
            "data": {
                "train": [source.record() for source in train],
                "validation": [source.record() for source in other],
            },
        },
    )


def _require_no_overlap(train: Sequence[_Source], other: Sequence[_Source]) -> None:
    for one in train:
        for two in other:
            if one.episodes is not None and two.episodes is not None:
                require_no_shared_frames(one.episodes, two.episodes)
    trained = [recording for source in train for recording in source.chosen(held_out=False)]
    tested = [recording for source in train for recording in source.chosen(held_out=True)]
    tested += [recording for source in other for recording in source.recordings]
    require_disjoint(
        *([(str(r.path), r.frame_checksums()) for r in some] for some in (trained, tested))
    )


def _open(folder: Path, sensor: str | None, keys: Mapping[str, str] | None) -> _Source:
    folder = folder if is_pattern(folder) else local_folder(folder)
    if is_pattern(folder) or (folder / "meta").exists():
        episodes = load_episodes(folder, keys)
        return _Source(folder, frames.find_sensor_name(sensor, episodes), episodes)
    if has_labels(folder):
        found = read_labelled_videos(folder)
        if all(video.held_out for video in found):
            raise UserError(
                f"{folder} has no video to train on: name the split train or unlabelled in labels.csv"
            )
    else:
        found = read_recordings(folder, sensor)
    recorded = found[0].sensor
    if sensor not in (None, recorded):
        raise UserError(f"{folder} was recorded with {recorded}, not {sensor}")
    return _Source(folder, recorded, None, found)


def _join(draws: list[Draw]) -> Draw:
    return lambda count, seed, offsets: frames.TouchFrames.joined(
        [draw(count, seed, offsets) for draw in draws]
    )
