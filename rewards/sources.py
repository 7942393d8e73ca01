"""What can be measured: episodes of a set, or a plain video or folder of frames.

Opening a source finds every mistake that can be found without a network, so that it is told before
the encoders are loaded.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar

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
from touchgoal.episodes.media import read_frames
from touchgoal.episodes.metadata import INFO
from touchgoal.episodes.store import EpisodeSet
from touchgoal.rewards.embedding_distance import EmbeddedEpisode, EpisodeEmbedder, missing_camera
from touchgoal.rewards.goals import Goal, GoalSpec, Modality, assign_goals, check_goal
from touchgoal.rewards.normalizer import EmbeddingSource, scene_of
from touchgoal.runtime.errors import UserError

CAMERAS = (FRONT, WRIST)


@dataclass(frozen=True)
class EpisodeSource:
    """Chosen episodes of a set, measured by one camera and, if it has any, its fingertips.

    Attributes:
        path: the set's folder.
        camera: vocabulary key of the camera.
        indices: of the chosen episodes.
        with_touch: whether touch is measured.
    """

    path: Path
    camera: str
    indices: tuple[int, ...]
    with_touch: bool

    @cached_property
    def episodes(self) -> EpisodeSet:
        """The whole set."""
        return EpisodeSet(self.path)

    @property
    def sides(self) -> tuple[str, ...]:
        """The fingertips that are measured, as vocabulary keys."""
        return tuple(k for k in TACTILE if self.with_touch and k in self.episodes.features)

    @property
    def sensor(self) -> str | None:
        """Of the episodes' fingertips, None if unknown."""
        metas = [self.episodes.meta(i) for i in self.indices]
        return next((str(m["sensor"]) for m in metas if m.get("sensor")), None)

    @property
    def scene(self) -> str:
        """Where the episodes were recorded, see `scene_of`."""
        return scene_of(self.episodes.features)

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """What the episodes can be measured in."""
        image: tuple[Modality, ...] = ("image",) if self.camera in self.episodes.features else ()
        return (*image, "tactile", "text") if self.sides else image

    @property
    def names(self) -> list[str]:
        """Names for the reports, in the order of `embed`."""
        return [f"episode_{i:03d}" for i in self.indices]

    def check(self) -> None:
        """UserError for whatever would stop the work: damage, a missing camera, mixed sensors."""
        cameras = [key for key in CAMERAS if key in self.episodes.features]
        if self.camera not in cameras and (cameras or not self.sides):
            raise UserError(missing_camera(str(self.path), self.camera, cameras))
        for i in self.indices:  # a damaged file is found now, before the work, not after half of it
            if self.episodes.lengths[i] < 2:
                raise UserError(
                    f"episode {i} of {self.path} has one frame: a curve needs at least 2"
                )
            self.episodes.read(i, [next(iter(self.episodes.features))], [0])
        metas = [self.episodes.meta(i) for i in self.indices]
        sensors = {str(m["sensor"]) for m in metas if m.get("sensor")}
        if len(sensors) > 1:
            raise UserError(
                f"{self.path} mixes the sensors {', '.join(sorted(sensors))}: choose --index"
            )

    def check_goals(self, specs: Sequence[GoalSpec], picture_words: bool) -> Goal:
        """What to be near; UserError if it cannot be read for one of the episodes."""
        goal = assign_goals(specs, self.modalities, picture_words)
        shortest = min(self.indices, key=lambda i: self.episodes.lengths[i])
        name, length = f"{self.path.name}#{shortest}", self.episodes.lengths[shortest]
        check_goal(goal, length, name, self.camera, self.sides)
        return goal

    def made_with(self, embedder: EpisodeEmbedder) -> EmbeddingSource:
        """What the embeddings of these episodes are made with."""
        return embedder.made_with

    def embed(
        self, embedder: EpisodeEmbedder, descriptions: bool = False
    ) -> Iterator[EmbeddedEpisode]:
        """Each episode in turn."""
        features = self.episodes.features
        keys = [k for k in (self.camera, *TACTILE, TRUTH_CONTACT) if k in features]
        for i in self.indices:
            episode = self.episodes.read(i, keys)
            name = f"{self.path.name}#{i}"
            yield embedder.embed_episode(episode, self.episodes.fps, name, descriptions)


@dataclass(frozen=True)
class VideoSource:
    """A video file, or a folder of pictures: pictures alone, of a camera that nobody knows."""

    path: Path
    frames: UInt8[np.ndarray, "n h w 3"]
    fps: float

    sensor: ClassVar[None] = None
    scene: ClassVar[str] = "a plain video"
    modalities: ClassVar[tuple[Modality, ...]] = ("image",)
    camera: ClassVar[str] = FRONT
    sides: ClassVar[tuple[str, ...]] = ()

    @property
    def names(self) -> list[str]:
        """Name for the report."""
        return [self.path.stem or "video"]

    @property
    def goals_it_takes(self) -> str:
        """For people: which goals this can be measured against, and why no other."""
        return (
            f"{self.path.name}: {len(self.frames)} frames at {self.fps:g} per second, pictures "
            "alone. Its goals are pictures: last, frame:K, image:PATH or episode:ROOT#K; a sentence "
            "(text:...) needs towers that compare pictures with words: --towers CLIP"
        )

    def check_goals(self, specs: Sequence[GoalSpec], picture_words: bool) -> Goal:
        """What to be near; UserError if it cannot be read, or says words the towers do not know."""
        goal = assign_goals(specs, self.modalities, picture_words)
        check_goal(goal, len(self.frames), self.path.name, FRONT, ())
        return goal

    def made_with(self, embedder: EpisodeEmbedder) -> EmbeddingSource:
        """What the embeddings of this video are made with: nobody knows its camera."""
        return replace(embedder.made_with, camera="")

    def embed(
        self, embedder: EpisodeEmbedder, descriptions: bool = False
    ) -> Iterator[EmbeddedEpisode]:
        """The video; it has no descriptions."""
        yield embedder.embed_video(self.frames, self.fps, self.path.name)


def open_source(
    path: Path, camera: str, index: Sequence[int] = (), with_touch: bool = True
) -> EpisodeSource | VideoSource:
    """Open what is to be measured, and check it.

    Args:
        path: a set of episodes, or the folder of a run that holds one as `episodes`; a video file;
            a folder of pictures.
        camera: the episodes' camera, by its key or its last word ("front"); no matter for a video.
        index: which episodes of the set; none for all.
        with_touch: whether the episodes' touch is measured.

    Raises:
        UserError: nothing there, damaged, no such camera or episode, fewer than 2 frames.
    """
    if not path.exists():
        raise UserError(f"{path} does not exist: give a set of episodes, a video or a folder")
    key = camera if camera.startswith(IMAGE_PREFIX) else f"{IMAGE_PREFIX}{camera}"
    if key not in CAMERAS:
        names = " or ".join(name.removeprefix(IMAGE_PREFIX) for name in CAMERAS)
        raise UserError(f"there is no camera '{camera}': choose {names}")
    for root in (path, path / "episodes"):
        if (root / INFO).exists():
            return _open_episodes(root, key, index, with_touch)
    if index:
        raise UserError(f"{path} is no set of episodes: leave --index out")
    frames, fps = read_frames(path)
    if len(frames) < 2:
        raise UserError(f"{path} has one frame: a curve needs at least 2")
    return VideoSource(path, frames, fps or CONTROL_HZ)


def _open_episodes(
    root: Path, camera: str, index: Sequence[int], with_touch: bool
) -> EpisodeSource:
    episodes = EpisodeSet(root)
    for i in index:
        if not 0 <= i < len(episodes):
            raise UserError(f"{root} has no episode {i}; it has 0 to {len(episodes) - 1}")
    if not len(episodes):
        raise UserError(f"{root} has no episodes")
    source = EpisodeSource(root, camera, tuple(index or range(len(episodes))), with_touch)
    source.check()
    return source


def open_successes(
    paths: Sequence[Path], camera: str, with_touch: bool, assume_success: bool
) -> list[EpisodeSource] | list[VideoSource]:
    """Open the successful episodes of one set, or plain videos that their owner calls successes.

    Args:
        paths: one set of episodes, or several videos or folders of pictures.
        camera: see `open_source`.
        with_touch: see `open_source`.
        assume_success: whether episodes whose outcome is unknown count as successes.

    Raises:
        UserError: as `open_source`; several sets, or sets and videos; fewer than two successes.
    """
    sources = [open_source(path, camera, with_touch=with_touch) for path in paths]
    videos = [source for source in sources if isinstance(source, VideoSource)]
    sets = [source for source in sources if isinstance(source, EpisodeSource)]
    if len(sets) > 1 or (sets and videos):
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
            f"nobody recorded whether {len(unknown)} of {len(success)} episodes of "
            f"{sets[0].path} succeeded: give --assume-success if they did"
        )
    chosen = tuple(i for i, reached in success.items() if reached is None or reached)
    if len(chosen) < 2:
        raise UserError(
            f"a normalizer needs at least two successful episodes, {sets[0].path} has {len(chosen)}"
        )
    return [replace(sets[0], indices=chosen)]
