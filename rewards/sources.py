"""Sources of trajectories: episodes of a set, or a plain video or folder of images."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from touchgoal.control.features import (
    CONTROL_HZ,
    FRONT,
    IMAGE_PREFIX,
    TACTILE,
    TRUTH_CONTACT,
    WRIST,
)
from touchgoal.episodes.format.set_files import INFO
from touchgoal.episodes.media import read_frames
from touchgoal.episodes.store import EpisodeSet
from touchgoal.episodes.touches import check_fingertips
from touchgoal.rewards.distance.normalizer import scene_of
from touchgoal.rewards.features.embedded import EmbeddedEpisode
from touchgoal.rewards.features.embedder import EpisodeEmbedder, missing_camera
from touchgoal.rewards.goals import Inputs
from touchgoal.runtime.errors import UserError

CAMERAS = (FRONT, WRIST)


@dataclass(frozen=True)
class EpisodeSource:
    """Chosen episodes of a set, with one camera and, if there are any, the fingertips."""

    path: Path  # the set's folder
    camera: str  # key of the camera
    indices: tuple[int, ...]  # the chosen episodes
    with_touch: bool  # whether touch is measured

    @cached_property
    def episodes(self) -> EpisodeSet:
        """The whole set."""
        return EpisodeSet(self.path)

    @property
    def inputs(self) -> Inputs:
        """Everything known about the episodes before they are embedded."""
        episodes = self.episodes
        shortest = min(self.indices, key=lambda i: episodes.lengths[i])
        return Inputs(
            name=f"{self.path.name}#{shortest}",
            camera=self.camera if self.camera in episodes.features else None,
            sides=tuple(k for k in TACTILE if self.with_touch and k in episodes.features),
            sensor=next(iter(self._sensors()), None),
            scene=scene_of(episodes.features),
            length=episodes.lengths[shortest],
            cameras=tuple(key for key in CAMERAS if key in episodes.features),
        )

    @property
    def names(self) -> list[str]:
        """File names of the reports, in the order of `embed`."""
        return [f"episode_{i:03d}" for i in self.indices]

    @property
    def _keys(self) -> list[str]:
        wanted = (*CAMERAS, *TACTILE, TRUTH_CONTACT)
        return [key for key in wanted if key in self.episodes.features]

    def _sensors(self) -> set[str]:
        metas = [self.episodes.meta(i) for i in self.indices]
        return {str(meta["sensor"]) for meta in metas if meta.get("sensor")}

    def check(self) -> None:
        """Raise UserError for a damaged or missing file, a missing camera, or mixed sensors."""
        cameras = [key for key in CAMERAS if key in self.episodes.features]
        if self.camera not in cameras and (cameras or not self.inputs.sides):
            raise UserError(missing_camera(str(self.path), self.camera, cameras))
        for i in self.indices:
            if self.episodes.lengths[i] < 2:
                raise UserError(
                    f"episode {i} of {self.path} has one frame: a curve needs at least 2"
                )
            self.episodes.read(i, self._keys, [0])
        if len(sensors := self._sensors()) > 1:
            raise UserError(
                f"{self.path} mixes the sensors {', '.join(sorted(sensors))}: choose --index"
            )
        if self.with_touch:
            check_fingertips(self.episodes, self.indices)

    def embed(
        self, embedder: EpisodeEmbedder, descriptions: bool = False
    ) -> Iterator[EmbeddedEpisode]:
        """Embed each episode in turn."""
        for i in self.indices:
            episode = self.episodes.read(i, self._keys)
            name = f"{self.path.name}#{i}"
            yield embedder.embed_episode(episode, self.episodes.fps, name, descriptions)


@dataclass(frozen=True)
class VideoSource:
    """A video file, or a folder of images: images alone, of an unknown camera."""

    path: Path
    frames: UInt8[np.ndarray, "n h w 3"]
    fps: float

    @property
    def inputs(self) -> Inputs:
        """Everything known about the video before it is embedded."""
        return Inputs(self.path.name, camera="", scene="a plain video", length=len(self.frames))

    @property
    def names(self) -> list[str]:
        """File name of the report."""
        return [self.path.stem or "video"]

    @property
    def summary(self) -> str:
        """Length, rate, and the goals that images alone can take, for people."""
        return (
            f"{self.path.name}: {len(self.frames)} frames at {self.fps:g} per second, images "
            "alone. Its goals are images: last, frame:K, image:PATH or episode:ROOT#K; a sentence "
            "(text:...) needs towers that compare images with words: --towers CLIP"
        )

    def embed(
        self, embedder: EpisodeEmbedder, descriptions: bool = False
    ) -> Iterator[EmbeddedEpisode]:
        """Embed the video; it has no descriptions."""
        yield embedder.embed_video(self.frames, self.fps, self.path.name)


Source = EpisodeSource | VideoSource


def open_source(
    path: Path,
    camera: str,
    index: Sequence[int] = (),
    with_touch: bool = True,
    fps: float | None = None,
) -> Source:
    """Open and check a source.

    UserError: nothing there, damaged, no such camera or episode, fewer than 2 frames, or an option
    that the source does not take.

    Args:
        path: a set of episodes, or the folder of a run that holds one as `episodes`; a video file;
            a folder of images.
        camera: the episodes' camera, by its key or its last word ("front"); unused for a video.
        index: which episodes of the set; none for all.
        fps: frames per second of a folder of images; None for 20.
    """
    if not path.exists():
        raise UserError(f"{path} does not exist: give a set of episodes, a video or a folder")
    key = camera if camera.startswith(IMAGE_PREFIX) else f"{IMAGE_PREFIX}{camera}"
    if key not in CAMERAS:
        names = " or ".join(name.removeprefix(IMAGE_PREFIX) for name in CAMERAS)
        raise UserError(f"there is no camera '{camera}': choose {names}")
    root = next((r for r in (path, path / "episodes") if (r / INFO).exists()), None)
    if fps is not None and (root is not None or not path.is_dir()):
        raise UserError(f"{path} states its own frame rate: leave --fps out")
    if root is not None:
        return _open_episodes(root, key, index, with_touch)
    if index:
        raise UserError(f"{path} is not a set of episodes: leave --index out")
    frames, rate = read_frames(path)
    if len(frames) < 2:
        raise UserError(f"{path} has one frame: a curve needs at least 2")
    return VideoSource(path, frames, fps or rate or CONTROL_HZ)


def _open_episodes(
    root: Path, camera: str, index: Sequence[int], with_touch: bool
) -> EpisodeSource:
    episodes = EpisodeSet(root)
    for i in index:
        if not 0 <= i < len(episodes):
            raise UserError(f"{root} has no episode {i}; it has 0 to {len(episodes) - 1}")
        if index.count(i) > 1:
            raise UserError(f"--index names episode {i} {index.count(i)} times: name it once")
    if not len(episodes):
        raise UserError(f"{root} has no episodes")
    source = EpisodeSource(root, camera, tuple(index or range(len(episodes))), with_touch)
    source.check()
    return source


def open_successes(
    paths: Sequence[Path], camera: str, with_touch: bool, assume_success: bool
) -> list[EpisodeSource] | list[VideoSource]:
    """Open the successful episodes of one set, or several plain videos of successes.

    With `assume_success` episodes without a recorded outcome count. UserError: as `open_source`; no
    source, several sets, or sets and videos; fewer than two successes.
    """
    sources = [open_source(path, camera, with_touch=with_touch) for path in paths]
    videos = [source for source in sources if isinstance(source, VideoSource)]
    sets = [source for source in sources if isinstance(source, EpisodeSource)]
    if not sources or len(sets) > 1 or (sets and videos):
        raise UserError("give one set of episodes, or several videos")
    if videos:
        if len(videos) < 2:
            raise UserError("a normalizer needs at least two successful videos; give more of them")
        return videos
    episodes = sets[0].episodes
    success = {i: episodes.meta(i).get("success") for i in sets[0].indices}
    unknown = [i for i, reached in success.items() if reached is None]
    if unknown and not assume_success:
        raise UserError(
            f"{len(unknown)} of {len(success)} episodes of {sets[0].path} have no recorded "
            "outcome: give --assume-success if they succeeded"
        )
    chosen = tuple(i for i, reached in success.items() if reached is None or reached)
    if len(chosen) < 2:
        raise UserError(
            f"a normalizer needs at least two successful episodes, {sets[0].path} has {len(chosen)}"
        )
    return [replace(sets[0], indices=chosen)]
