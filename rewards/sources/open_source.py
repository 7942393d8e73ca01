"""Open the source of trajectories that a user names."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from touchgoal.control.features import CAMERAS, IMAGE_PREFIX
from touchgoal.episodes.format.remote import local_folder
from touchgoal.episodes.format.set_files import INFO
from touchgoal.rewards.goals import Inputs
from touchgoal.rewards.sources.episode_trajectories import EpisodeTrajectory, open_episodes
from touchgoal.rewards.sources.trajectory import Source, Trajectory
from touchgoal.rewards.sources.video_trajectories import open_videos
from touchgoal.runtime.errors import UserError


def open_source(
    path: Path,
    camera: str,
    index: Sequence[int] = (),
    with_touch: bool = True,
    fps: float | None = None,
    keys: Mapping[str, str] | None = None,
    background: Sequence[Path] = (),
) -> Source:
    """Open a source; what it holds is read later.

    UserError: nothing there, no such camera or episode, nothing that can be measured, or an option
    that the source does not take.

    Args:
        path: a set of episodes, or the folder of a run that holds one as `episodes`; a video file; a
            folder of images; a folder of several videos or folders of images.
        camera: the episodes' camera, by its key or its last word ("front"); of videos, what a file
            shows that does not say so in its name.
        index: which episodes of the set; none for all.
        fps: frames per second of folders of images; None for 20.
        keys: new keys of features of an episode set, see `EpisodeSet`.
        background: the fingertips of videos untouched, see `open_videos`.
    """
    path = local_folder(path)
    if not path.exists():
        raise UserError(f"{path} does not exist: give a set of episodes, a video or a folder")
    key = camera if camera.startswith(IMAGE_PREFIX) else f"{IMAGE_PREFIX}{camera}"
    root = next((r for r in (path, path / "episodes") if (r / INFO).exists()), None)
    if root is None:
        if index:
            raise UserError(f"{path} is not a set of episodes: leave --index out")
        if key not in CAMERAS:
            names = " or ".join(name.removeprefix(IMAGE_PREFIX) for name in CAMERAS)
            raise UserError(f"there is no camera '{camera}': choose {names}")
        return open_videos(path, key, with_touch, fps, background)
    if background:
        raise UserError(
            f"{path} is a set of episodes, which begin untouched: leave --background out"
        )
    if fps is not None:
        raise UserError(f"{path} states its own frame rate: leave --fps out")
    source = open_episodes(root, key, index, with_touch, keys)
    if root == path:
        return source
    return replace(source, summary=f"{path} is not a set of episodes; measuring the set {root}")


def open_successes(
    paths: Sequence[Path],
    camera: str,
    with_touch: bool,
    assume_success: bool,
    keys: Mapping[str, str] | None = None,
    background: Sequence[Path] = (),
) -> tuple[Inputs, list[Trajectory], list[EpisodeTrajectory]]:
    """Open the successful episodes of sets, or several plain videos of successes; and the sets' failures.

    The inputs are those of the first one.
    With `assume_success` episodes without a recorded outcome count. UserError: as `open_source`; no
    source, sets of different tasks, cameras or sensors, or sets and videos; fewer than two successes.
    """
    sources = [open_source(p, camera, (), with_touch, None, keys, background) for p in paths]
    sets = [s for s in sources if isinstance(s.trajectories[0], EpisodeTrajectory)]
    if not sources or 0 < len(sets) < len(sources):
        raise UserError("give sets of episodes, or several videos")
    for path, other in zip(paths, sets, strict=False):
        if other.inputs.kind != sets[0].inputs.kind:
            raise UserError(
                f"{path} has another task, camera or sensor than {paths[0]}: fit it alone"
            )
    for skipped in (one for source in sources for one in source.skipped):
        if not sets:
            raise UserError(f"{skipped.name} is broken: {skipped.reason}")
        print(f"left out: {skipped.reason}", file=sys.stderr)
    found = [t for source in sources for t in source.trajectories]
    unknown = sum(t.meta.get("success") is None for t in found)
    if sets and unknown and not assume_success:
        raise UserError(
            f"{unknown} of {len(found)} episodes of {' '.join(map(str, paths))} have no recorded outcome: give "
            "--assume-success if they succeeded"
        )
    episodes = [t for t in found if isinstance(t, EpisodeTrajectory)]
    failed = [t for t in episodes if t.meta.get("success") is False]
    if len(found) - len(failed) < 2:
        raise UserError("a normalizer needs at least two successful episodes or videos")
    return sources[0].inputs, [t for t in found if t not in failed], failed
