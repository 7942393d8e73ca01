"""Which recorded episodes a policy learns from, and of which task and sensor they are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from touchgoal.episodes.recording import CORRECTED
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError


@dataclass(frozen=True)
class ChosenEpisodes:
    """Episodes of a set to learn from.

    Attributes:
        rows: their indices.
        failed: how many were left out because they failed.
        unknown: how many whose success nobody recorded; left out unless they were asked for.
    """

    rows: list[int]
    failed: int
    unknown: int

    def __str__(self) -> str:
        """Such as `12 episodes (3 that failed left out)`."""
        left = [f"{self.failed} that failed"] * bool(self.failed)
        left += [f"{self.unknown} of unknown success"] * bool(self.unknown)
        return f"{len(self.rows)} episodes" + (f" ({', '.join(left)} left out)" if left else "")


def choose_episodes(episodes: EpisodeSet, include_unknown: bool = False) -> ChosenEpisodes:
    """The episodes that succeeded, and those in which an expert corrected a policy.

    Args:
        episodes: the set.
        include_unknown: also those that do not say whether they succeeded, such as recordings of an
            arm that nobody judged.

    Raises:
        UserError: none is left.
    """
    known = [succeeded(episodes.meta(i)) for i in range(len(episodes))]
    rows = [i for i, good in enumerate(known) if good or (good is None and include_unknown)]
    unknown = 0 if include_unknown else known.count(None)
    chosen = ChosenEpisodes(rows, known.count(False), unknown)
    if not rows:
        remedy = "record successful ones"
        if unknown:
            remedy = "say in their meta whether they succeeded, or add --include-unknown"
        raise UserError(
            f"no episode of {episodes.root} to learn from ({chosen.failed} failed, {unknown} of "
            f"unknown success): {remedy}"
        )
    return chosen


def check_apart(
    data: tuple[EpisodeSet, Sequence[int]], validation: tuple[EpisodeSet, Sequence[int]]
) -> None:
    """UserError if an episode is both learned from and judged by, in one folder or in two."""
    known = {data[0].episode_checksum(i) for i in data[1]}
    for i in validation[1]:
        if validation[0].episode_checksum(i) in known:
            raise UserError(
                f"episode {i} of {validation[0].root} is also in {data[0].root}: judge by episodes "
                "that are not learned from"
            )


def succeeded(meta: Mapping[str, Any]) -> bool | None:
    """Whether an episode shows what to do; None if its facts do not tell."""
    if meta.get("outcome") == CORRECTED:
        return True
    if meta.get("outcome") == "unknown" or meta.get("success") is None:
        return None
    return bool(meta["success"])


def common_task(sets: Sequence[tuple[EpisodeSet, Sequence[int]]]) -> str:
    """The task that all chosen episodes of some sets are of; "" if none says.

    Raises:
        UserError: they are of several.
    """
    return _common("task", sets, task_of)


def common_sensor(sets: Sequence[tuple[EpisodeSet, Sequence[int]]]) -> str:
    """The fingertip sensor of all chosen episodes; "" if none says; UserError if several."""
    return _common("sensor", sets, lambda meta: str(meta.get("sensor", "")))


def task_of(meta: Mapping[str, Any]) -> str:
    """An episode's task by its facts; older sets say it by the wire or the object's shape alone."""
    if "task" in meta:
        return str(meta["task"])
    if "wire" in meta:
        return "bead-maze"
    return "pick-place" if "shape" in meta else ""


def _common(what: str, sets: Sequence[tuple[EpisodeSet, Sequence[int]]], fact: Any) -> str:
    found = {fact(s.meta(i)): s.root for s, rows in sets for i in rows}
    if len(found) > 1:
        kinds = "; ".join(f"{name or 'unknown'} in {root}" for name, root in found.items())
        raise UserError(
            f"the episodes are of more than one {what} ({kinds}): train on one at a time"
        )
    return next(iter(found), "")
