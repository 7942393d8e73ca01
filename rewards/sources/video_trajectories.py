"""Videos and folders of images as trajectories, with tactile videos beside the camera's.

The name of a file says what it shows. NAME.mp4 is the camera; beside it NAME_wrist.mp4 is a second
one, NAME_tactile_left.mp4 and NAME_tactile_right.mp4 are the fingertips (NAME_tactile.mp4: the only
one). A trajectory may also be a folder with front.mp4, wrist.mp4, tactile_left.mp4 and so on. A
folder of images stands for a video everywhere. `labels.csv` beside them (columns file and outcome, and
if known object and task) says how each one ended.
"""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from touchgoal.control import features as ft
from touchgoal.control.arrays import Images
from touchgoal.control.sensors.clip import IMAGES, VIDEOS, Clip, in_natural_order, open_clip
from touchgoal.control.tactile.background import SETTLES_WITHIN
from touchgoal.episodes.importers.labelled_videos import read_table
from touchgoal.episodes.schema import Episode, MetaValue
from touchgoal.rewards.goals import Inputs
from touchgoal.rewards.sources.trajectory import Skipped, Source, Trajectory, frames_per_chunk
from touchgoal.runtime.errors import UserError

_ROLES = {
    "front": ft.FRONT,
    "wrist": ft.WRIST,
    "tactile_left": ft.TACTILE_LEFT,
    "tactile_right": ft.TACTILE_RIGHT,
    "tactile": ft.TACTILE_LEFT,
}
"""Last words of a file's name -> what it shows."""
_LABELS = "labels.csv"
_FACTS = ("object", "outcome", "task")
_SAME_RATE = 0.01  # share by which the frame rates of one trajectory may differ


@dataclass(frozen=True, eq=False)
class VideoTrajectory(Trajectory):
    """One trajectory of video files or folders of images."""

    clips: Mapping[str, Clip]  # by what they show

    def checksum(self) -> str:
        """Return sizes and times of the files, and a hash of the untouched frames given apart."""
        given = (clip.path for clip in self.clips.values())
        files = [f for p in given for f in (in_natural_order(p.iterdir()) if p.is_dir() else [p])]
        stats = [f"{file.stat().st_size}:{file.stat().st_mtime_ns}" for file in files]
        hashes = [
            hashlib.sha256(frames.tobytes()).hexdigest() for frames in self.untouched.values()
        ]
        return " ".join([*stats, *hashes])

    def chunks(self) -> Iterator[Episode]:
        """See Trajectory."""
        heights_widths = [clip.shape for clip in self.clips.values()]
        size = frames_per_chunk(sum(3 * height * width for height, width in heights_widths))
        for chunks in zip_longest(*(clip.chunks(size) for clip in self.clips.values())):
            frames = dict(zip(self.clips, chunks, strict=True))
            if len({0 if chunk is None else len(chunk) for chunk in chunks}) > 1:
                raise UserError(f"{self.name}: its videos end at different frames")
            yield Episode(frames, self.name, dict(self.meta))


def open_videos(
    path: Path, camera: str, with_touch: bool, fps: float | None, background: Sequence[Path] = ()
) -> Source:
    """Open a video file, a folder of images, or a folder that holds several of them.

    UserError: no video or image, a frame rate given that the videos state themselves, or no
    trajectory left that can be measured.

    Args:
        camera: key of the camera that a file without a role shows.
        fps: frames per second of folders of images; None for 20.
        background: image, video or folder of images of each fingertip untouched, left before right;
            none: the first frames of each video.
    """
    found = _find(path, camera)
    apart = [next(open_clip(file).chunks(SETTLES_WITHIN)) for file in background]
    labels = _read_labels(path if path.is_dir() else path.parent)
    offset, opened = 0, list[VideoTrajectory]()
    skipped: list[Skipped] = []
    for i, (name, files) in enumerate(found.items()):
        kept = {k: f for k, f in files.items() if with_touch or k not in ft.TACTILE}
        try:
            clips = _open_clips(name, kept, fps)
            untouched = _backgrounds(name, clips, apart)
        except UserError as error:
            skipped.append(Skipped(name, str(error)))
            continue
        first = next(iter(clips.values()))
        rate, meta = fps or first.fps or ft.CONTROL_HZ, labels.get(name, {})
        opened.append(
            VideoTrajectory(
                name, name, i, offset, first.length, rate, meta, clips, untouched=untouched
            )
        )
        offset += first.length
    if not opened:
        raise UserError(skipped[0].reason)
    keys = opened[0].clips.keys()
    if other := next((t for t in opened if t.clips.keys() != keys), None):
        raise UserError(
            f"{other.name} shows {_words(other.clips)}, but {opened[0].name} "
            f"{_words(keys)}: measure them apart, or give each the same videos"
        )
    shortest = min(opened, key=lambda trajectory: trajectory.length)
    length = shortest.length
    inputs = Inputs.of(shortest.source, keys, camera, scene="a plain video", length=length)
    about = f"{length} frames at {shortest.fps:g} per second"
    if len(opened) > 1:
        about = f"{len(opened):,} trajectories, {offset:,} frames"
    return Source(inputs, opened, skipped, f"{path.name}: {about}, {_words(keys)}")


def _find(path: Path, camera: str) -> dict[str, dict[str, Path]]:
    """Return name -> what is shown -> file or folder of images."""
    if path.is_file():
        name = _split_name(path)[0] or path.parent.name
        return {name: _group(path.parent, camera).get(name, {camera: path})}
    found = _group(path, camera)
    if "" in found:
        return {path.resolve().name: found[""]}
    for folder in filter(Path.is_dir, in_natural_order(path.iterdir())):
        groups = _group(folder, camera)
        if "" in groups or len(groups) == 1:
            found[folder.name] = groups.get("") or next(iter(groups.values()))
    if not found:
        open_clip(path)  # says what is missing
    return found


def _group(folder: Path, camera: str) -> dict[str, dict[str, Path]]:
    """Return the videos of a folder by the name that they share, and by what they show.

    That name is "" for what is named by what it shows alone (front.mp4, or a folder of images), and for
    a folder of images itself.
    """
    groups, images = dict[str, dict[str, Path]](), False
    for path in in_natural_order(folder.iterdir()):
        images |= path.suffix.lower() in IMAGES
        if path.suffix.lower() not in VIDEOS if path.is_file() else path.stem not in _ROLES:
            continue
        name, role = _split_name(path)
        shows = groups.setdefault(name, {})
        key = _ROLES.get(role, camera)
        if key in shows:
            raise UserError(f"{path} and {shows[key]} both show {_words([key])}: rename one")
        shows[key] = path
    if images:
        groups.setdefault("", {camera: folder})
    return groups


def _split_name(path: Path) -> tuple[str, str]:
    """Return a file's name without its role, and the role: "a_wrist.mp4" -> "a", "wrist"."""
    for role in _ROLES:
        if path.stem == role or path.stem.endswith(f"_{role}"):
            return path.stem.removesuffix(role).removesuffix("_"), role
    return path.stem, ""


def _open_clips(name: str, files: Mapping[str, Path], fps: float | None) -> dict[str, Clip]:
    clips = {key: open_clip(files[key]) for key in (*ft.CAMERAS, *ft.TACTILE) if key in files}
    if not clips:
        raise UserError(f"{name} has nothing to measure: give a camera's video")
    first = next(iter(clips.values()))
    for clip in clips.values():
        if clip.length < 2:
            raise UserError(f"{clip.path} has one frame: a curve needs at least 2")
        if clip.length != first.length:
            raise UserError(
                f"{clip.path} has {clip.length} frames, {first.path} {first.length}: "
                "a trajectory's videos need equally many"
            )
        if abs((clip.fps or 1) / (first.fps or 1) - 1) > _SAME_RATE:
            raise UserError(f"{clip.path} and {first.path} have different frame rates")
    if fps is not None and first.fps is not None:
        raise UserError(f"{first.path} states its own frame rate: leave --fps out")
    return clips


def _backgrounds(
    name: str, clips: Mapping[str, Clip], given: Sequence[Images]
) -> dict[str, Images]:
    """Return the untouched frames given for each fingertip; UserError if they do not fit its video."""
    sides = [key for key in ft.TACTILE if key in clips] if given else []
    sizes = [clips[side].shape for side in sides]
    if (there := [frames.shape[1:3] for frames in given]) != sizes:
        raise UserError(f"{name}: --background has rows and columns {there}, its videos {sizes}")
    return dict(zip(sides, given, strict=True))


def _read_labels(folder: Path) -> dict[str, dict[str, MetaValue]]:
    """Return the facts in `labels.csv` by name of the trajectory; {} without the file."""
    path = folder / _LABELS
    labels: dict[str, dict[str, MetaValue]] = {}
    for row in read_table(path, ("file", "outcome")) if path.is_file() else ():
        facts = labels[_split_name(Path(row["file"]))[0]] = {
            k: row[k] for k in _FACTS if row.get(k)
        }
        if row["outcome"]:
            facts["success"] = row["outcome"] == "success"
    return labels


def _words(keys: Iterable[str]) -> str:
    return ", ".join(key.removeprefix(ft.IMAGE_PREFIX) for key in sorted(keys))
