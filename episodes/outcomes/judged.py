"""Outcomes of episodes as a judge or a person told them later, kept in the set's folder in `judged.json`.

They are never mixed with the outcome that a person or a simulator recorded (meta `success`). A run that a
judge ended tells its verdict in meta `judged`, which this file overrides.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.json_file import read_json, write_json

JUDGED = "judged.json"
Verdict = Literal["success", "failure", "unsure"]


@dataclass(frozen=True)
class JudgedOutcome:
    """What is said of one episode."""

    verdict: Verdict
    by: Literal["judge", "person"] = "judge"
    cost: float | None = None  # of the end, in [0, 1], by the judge
    reasons: tuple[str, ...] = ()


def read_judged(episodes: EpisodeSet) -> dict[int, JudgedOutcome]:
    """Return the judged outcomes of a set by episode; UserError: the file is damaged."""
    found, first = {}, 0
    for one in episodes.sets:
        found |= {first + i: outcome for i, outcome in _read_judged(one).items()}
        first += len(one)
    return found


def _read_judged(episodes: EpisodeSet) -> dict[int, JudgedOutcome]:
    told = {i: episodes.meta(i).get("judged") for i in range(len(episodes))}
    found: dict[int, Any] = {i: JudgedOutcome(v) for i, v in told.items() if v}  # pyright: ignore[reportArgumentType]
    path = episodes.root / JUDGED
    if not path.is_file():
        return found
    otherwise = f"{path} is damaged: delete it and judge the set again"
    return found | read_json(path, dict[int, JudgedOutcome], otherwise)


def write_judged(episodes: EpisodeSet, outcomes: Mapping[int, JudgedOutcome]) -> None:
    """Write outcomes beside those that the set's file has already, atomically."""
    added: dict[Path, dict[str, JudgedOutcome]] = {}
    for i, outcome in outcomes.items():
        one, number = episodes.part(i)
        added.setdefault(one.root / JUDGED, {})[str(number)] = outcome
    for path, rows in added.items():
        there = json.loads(path.read_text()) if path.is_file() else {}
        write_json(path, there | rows)
