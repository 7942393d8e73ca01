"""Choice and checks of the episodes that a policy is trained on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from touchgoal.control import features as ft
from touchgoal.episodes.faults import leave_out_faulty
from touchgoal.episodes.outcomes.judged import read_judged
from touchgoal.episodes.schema import CORRECTED
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies.training.action_meaning import ActionMeaning, joint_changes
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.config import TASKS

_READ = (ft.STATE, ft.COMMAND, ft.TCP_POSE, ft.WRENCH, ft.ACTION, *ft.TACTILE)
_PAUSE = 0.5  # s
_JOINT_MOTION = 2e-3  # rad since the first frame, or commanded since then
_WIDTH_MOTION = 5e-4  # m of gripper width, measured or commanded


@dataclass(frozen=True)
class ChosenEpisodes:
    """Episodes of a set to train on."""

    rows: list[int]  # their indices
    failed: int  # number of failed ones, which are left out
    unknown: int = 0  # number of those left out because their success is not recorded
    unsure: int = 0  # number of those left out because the judge was unsure

    def __str__(self) -> str:
        left = [f"{self.failed} that failed"] * bool(self.failed)
        left += [f"{self.unknown} of unknown success"] * bool(self.unknown)
        left += [f"{self.unsure} judged unsure"] * bool(self.unsure)
        return f"{len(self.rows)} episodes" + (f" ({', '.join(left)} left out)" if left else "")


def choose_episodes(episodes: EpisodeSet, include_unknown: bool = False) -> ChosenEpisodes:
    """Return the episodes that succeeded, and those in which an expert corrected a policy.

    `include_unknown` also takes those that do not say whether they succeeded, such as recordings of
    an arm. Faulty ones are left out and listed. UserError: none is left.
    """
    known = [succeeded(episodes.meta(i)) for i in range(len(episodes))]
    rows = [i for i, good in enumerate(known) if good or (good is None and include_unknown)]
    rows = _sound(episodes, rows)
    unknown = 0 if include_unknown else known.count(None)
    chosen = ChosenEpisodes(rows, known.count(False), unknown)
    if not rows:
        remedy = "record successful ones"
        if unknown:
            remedy = "say in their meta whether they succeeded, or add --include-unknown"
        raise UserError(
            f"no episode of {episodes.root} to train on ({chosen.failed} failed, {unknown} of "
            f"unknown success): {remedy}"
        )
    return chosen


def choose_judged(episodes: EpisodeSet) -> ChosenEpisodes:
    """Return the episodes that were judged successes; their recorded outcomes are not read.

    Faulty ones are left out and listed. UserError: an episode was not judged, or none is left.
    """
    judged = read_judged(episodes)
    if missing := len(episodes) - len(judged.keys() & set(range(len(episodes)))):
        raise UserError(
            f"{missing} of {len(episodes)} episodes of {episodes.root} were not judged: judge it "
            f"first: touchgoal judge {episodes.root}"
        )
    verdicts = [judged[i].verdict for i in range(len(episodes))]
    rows = _sound(episodes, [i for i, verdict in enumerate(verdicts) if verdict == "success"])
    if not rows:
        raise UserError(f"no episode of {episodes.root} was judged a success: record more of them")
    return ChosenEpisodes(rows, verdicts.count("failure"), unsure=verdicts.count("unsure"))


def find_pauses(
    episodes: EpisodeSet, rows: Sequence[int], meaning: ActionMeaning = "change"
) -> list[int]:
    """Return how many frames of each episode pass before arm or gripper moves or is commanded to.

    An episode without motion has no start to trim to: 0.
    """
    pauses = []
    for i in rows:
        state, action = episodes.read(i, [ft.STATE, ft.ACTION]).frames.values()
        action = joint_changes(action, state, meaning)
        joints = action.shape[1] - 1
        moving = np.abs(np.cumsum(action[:, :joints], axis=0)).max(1) > _JOINT_MOTION
        moving |= np.abs(action[:, -1] - action[0, -1]) > _WIDTH_MOTION
        moving |= np.abs(state[:, :joints] - state[0, :joints]).max(1) > _JOINT_MOTION
        moving |= np.abs(state[:, -1] - state[0, -1]) > _WIDTH_MOTION
        pauses.append(int(np.argmax(moving)))  # 0, too, where nothing moves
    return pauses


def report_pauses(pauses: Sequence[int], fps: int, trimmed: bool) -> None:
    """Print how many demonstrations begin with a pause, which a policy imitates by not starting."""
    long = [n / fps for n in pauses if n / fps >= _PAUSE]
    if long:
        what = "left out" if trimmed else "a policy may imitate it by not starting: --trim-pauses"
        print(
            f"{len(long)} of {len(pauses)} episodes begin with a pause of {min(long):.1f} to "
            f"{max(long):.1f} s; {what}"
        )


def find_task(chosen: Sequence[tuple[EpisodeSet, Sequence[int]]], task: str | None) -> str:
    """Return the task of the chosen episodes; it must be `task` if that is given.

    It may be one that no simulator knows.

    UserError: they are of several tasks or of another one, or name none and `task` is None.
    """
    root, found = chosen[0][0].root, common_fact("task", chosen)
    if task and found not in ("", task):
        raise UserError(f"{root} is of {found}, not of {task}: leave out --task")
    if not (found or task):
        raise UserError(
            f"{root} does not name its task: add --task {', '.join(TASKS)} or a name of your own"
        )
    return found or str(task)


def _sound(episodes: EpisodeSet, rows: Sequence[int]) -> list[int]:
    read = [key for key in _READ if key in episodes.features]
    return leave_out_faulty(episodes, rows, read)


def succeeded(meta: Mapping[str, Any]) -> bool | None:
    """Return whether an episode is a demonstration of success; None if its meta does not tell."""
    if meta.get("outcome") == CORRECTED:
        return True
    if meta.get("outcome") == "unknown" or meta.get("success") is None:
        return None
    return bool(meta["success"])


def common_fact(what: str, sets: Sequence[tuple[EpisodeSet, Sequence[int]]]) -> str:
    """Return the task or sensor of the episodes, "" if none is named; UserError if several."""
    found = {str(s.meta(i).get(what, "")): s.root for s, rows in sets for i in rows}
    if len(found) > 1:
        kinds = "; ".join(f"{name or 'unknown'} in {root}" for name, root in found.items())
        raise UserError(
            f"the episodes are of more than one {what} ({kinds}): train on one at a time"
        )
    return next(iter(found), "")
