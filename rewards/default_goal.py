"""Goals of trajectories among which some failed: the ends of the successes.

With `last`, every failure would end at a cost of 0.
"""

from collections.abc import Mapping, Sequence

from touchgoal.episodes.store import EpisodeSet
from touchgoal.rewards.goals import Bank, GoalSpec, OwnFrame
from touchgoal.rewards.sources.episode_trajectories import EpisodeTrajectory
from touchgoal.rewards.sources.trajectory import Trajectory
from touchgoal.runtime.errors import UserError


def goals_of(trajectories: Sequence[Trajectory]) -> dict[str, GoalSpec]:
    """Return the goal of each trajectory by name, where the user gave none.

    That is its own last frame. If a trajectory failed, it is the nearest end of the set's other
    successes with the same object; a success that is the only one with its object keeps its own end.
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
    successes = _successes(episodes[0].episodes)
    return {t.name: _successful_ends(t, successes) for t in episodes}


def _successes(episodes: EpisodeSet) -> dict[str, list[int]]:
    """Return the successful episodes of each object."""
    found: dict[str, list[int]] = {}
    for i in range(len(episodes)):
        meta = episodes.meta(i)
        if meta.get("success"):
            found.setdefault(str(meta.get("object", "")), []).append(i)
    return found


def _successful_ends(trajectory: EpisodeTrajectory, successes: Mapping[str, list[int]]) -> GoalSpec:
    root, what = trajectory.episodes.root, str(trajectory.meta.get("object", ""))
    same_object = successes.get(what, [])
    if set(same_object) - {trajectory.index}:
        return Bank(root, trajectory.episodes.keys)
    if same_object:
        return OwnFrame()
    raise UserError(
        f"failures are among the episodes, and no success of {root} has the object of "
        f"{trajectory.source} ({what or 'unknown'}): give a goal, --goal episode:SET#K"
    )
