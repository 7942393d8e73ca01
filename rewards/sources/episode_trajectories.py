"""Episodes of a set as trajectories, and their goals where the user gives none."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np

from touchgoal.control.features import CAMERAS, FRONT, TACTILE, TRUTH_CONTACT
from touchgoal.episodes.faults import find_faults
from touchgoal.episodes.schema import Episode, is_camera, is_image
from touchgoal.episodes.store import EpisodeSet
from touchgoal.episodes.touches import check_fingertips
from touchgoal.rewards.distance.normalizer import scene_of
from touchgoal.rewards.features.embedded import ARM
from touchgoal.rewards.goals import EpisodeEnds, GoalSpec, Inputs, OwnFrame, missing_camera
from touchgoal.rewards.sources.trajectory import Skipped, Source, Trajectory, frames_per_chunk
from touchgoal.runtime.errors import UserError

_LOOKED_AT = 8  # episodes whose first frames are checked before any work


@dataclass(frozen=True, eq=False)
class EpisodeTrajectory(Trajectory):
    """One episode of a set."""

    episodes: EpisodeSet
    keys: tuple[str, ...]  # the features that are read

    def checksum(self) -> str:
        """See Trajectory."""
        return self.episodes.episode_checksum(self.index)

    def read(self, frames: Sequence[int]) -> Episode:
        """Read some frames; UserError: a file is missing or unreadable."""
        return self.episodes.read(self.index, self.keys, frames)

    def chunks(self) -> Iterator[Episode]:
        """See Trajectory."""
        shapes = [self.episodes.features[key]["shape"] for key in self.keys if is_image(key)]
        size = frames_per_chunk(sum(int(np.prod(shape)) for shape in shapes))
        for start in range(0, self.length, size):
            yield self.read(range(start, min(start + size, self.length)))


def open_episodes(
    root: Path,
    camera: str,
    index: Sequence[int],
    with_touch: bool,
    keys: Mapping[str, str] | None = None,
) -> Source:
    """Open chosen episodes of a set, all of them by default.

    UserError: no such camera or episode, mixed sensors, fingertips that are not the sensor's or
    change places, or no episode left that can be measured.
    """
    episodes = EpisodeSet(root, complete=False, keys=keys)
    if not len(episodes):
        raise UserError(f"{root} has no episodes")
    for i in index:
        if not 0 <= i < len(episodes):
            raise UserError(f"{root} has no episode {i}; it has 0 to {len(episodes) - 1}")
        if index.count(i) > 1:
            raise UserError(f"--index names episode {i} {index.count(i)} times: name it once")
    chosen = list(index or range(len(episodes)))
    touch = tuple(key for key in TACTILE if with_touch and key in episodes.features)
    camera = _find_camera(episodes, camera, bool(touch))
    wanted = dict.fromkeys((*CAMERAS, camera, *touch, TRUTH_CONTACT, *ARM.values()))
    read = tuple(key for key in wanted if key in episodes.features)
    offsets, lengths = [0, *accumulate(episodes.lengths)], episodes.lengths
    found = [
        EpisodeTrajectory(
            name=f"episode_{i:03d}",
            source=f"{episodes.root.name}#{i}",
            index=i,
            offset=offsets[i],
            length=lengths[i],
            fps=episodes.fps,
            meta=episodes.meta(i),
            episodes=episodes,
            keys=read,
        )
        for i in chosen
    ]
    sensors = {str(t.meta["sensor"]) for t in found if t.meta.get("sensor")}
    if len(sensors) > 1:
        raise UserError(f"{root} mixes the sensors {', '.join(sorted(sensors))}: choose --index")
    tasks = {episodes.task(i) for i in chosen}
    if touch:
        seen = {chosen[i] for i in np.linspace(0, len(chosen) - 1, _LOOKED_AT).astype(int)}
        if readable := [i for i in sorted(seen) if _reads(episodes, i, touch)]:
            check_fingertips(episodes, readable)
    short = {t.index: t.source for t in found if t.length < 2}
    faults = find_faults(episodes, chosen, read)
    faults |= {i: f"{name} has one frame: a curve needs at least 2" for i, name in short.items()}
    broken = [Skipped(t.name, faults[t.index]) for t in found if t.index in faults]
    sound = [t for t in found if t.index not in faults]
    if not sound:
        raise UserError(broken[0].reason)
    shortest = min(sound, key=lambda t: t.length)
    about = {"sensor": next(iter(sensors), None), "scene": scene_of(episodes.features)}
    about["task"] = next(iter(tasks)) if len(tasks) == 1 else ""
    inputs = Inputs.of(shortest.source, read, camera, length=shortest.length, **about)
    return Source(inputs, sound, broken)


def _find_camera(episodes: EpisodeSet, camera: str, touch: bool) -> str:
    """Return the key of the camera; in place of the usual one a foreign set's only one."""
    cameras = [key for key in episodes.features if is_camera(key)]
    if camera in cameras or (touch and not cameras):
        return camera
    if episodes.foreign and camera == FRONT and len(cameras) == 1:
        print(f"{episodes.root} has one camera: measuring {cameras[0]}")
        return cameras[0]
    raise UserError(missing_camera(str(episodes.root), camera, cameras))


def _reads(episodes: EpisodeSet, i: int, keys: Sequence[str]) -> bool:
    """Return whether the first frame of an episode can be read; a broken one is skipped later."""
    try:
        episodes.read(i, keys, [0])
    except UserError:
        return False
    return True


def default_goals(trajectories: Sequence[Trajectory]) -> dict[str, GoalSpec]:
    """Return the goal of each trajectory by name, where the user gave none.

    That is its own last frame. With it every failure would end at a cost of 0, so if a trajectory
    failed, it is the nearest end of the set's other successes with the same object; a success that is the only one with its object keeps its own end.
    UserError: a failure among videos, or an object without a success.
    """
    failed = [t for t in trajectories if t.meta.get("success") is False]
    if not failed:
        return {t.name: OwnFrame() for t in trajectories}
    episodes = [t for t in trajectories if isinstance(t, EpisodeTrajectory)]
    if len(episodes) < len(trajectories):
        raise UserError(
            f"{failed[0].name} failed, and at its own last frame a failure costs 0, too: give the "
            "end of a success, --goal image:FILE or --goal episode:SET#K"
        )
    of, root = episodes[0].episodes, episodes[0].episodes.root
    successes: dict[str, list[int]] = {}  # of each object
    for i in range(len(of)):
        if (meta := of.meta(i)).get("success"):
            successes.setdefault(str(meta.get("object", "")), []).append(i)
    goals: dict[str, GoalSpec] = {}
    for t in episodes:
        what = str(t.meta.get("object", ""))
        if what not in successes:
            raise UserError(
                f"failures are among the episodes, and no success of {root} has the object of "
                f"{t.source} ({what or 'unknown'}): give a goal, --goal episode:SET#K"
            )
        alone = successes[what] == [t.index]
        goals[t.name] = OwnFrame() if alone else EpisodeEnds(root, keys=of.keys)
    return goals
