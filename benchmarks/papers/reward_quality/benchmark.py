"""Do last costs and curves tell outcomes apart, on objects held out from every fit?

Simulated successes, poor successes and thirteen kinds of failure, in two scenes: places and grip
force drawn anew for each episode, or the same in all. Goals are the ends of other successes with the
object that was asked for.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.options import CORES, BenchmarkOptions
from benchmarks.papers.reward_quality import tables
from benchmarks.papers.reward_quality.claims import judge_claims
from benchmarks.papers.reward_quality.embedding import EmbeddedFiles
from benchmarks.papers.reward_quality.judging import Judge, fit_judge
from benchmarks.papers.reward_quality.measures import (
    Judged,
    auc,
    diagonal,
    mean_of,
    order,
    rank_with_time,
)
from benchmarks.papers.reward_quality.recording import (
    KINDS,
    SCENES,
    SUBOPTIMAL,
    Recorded,
    Scene,
    Sizes,
    plan,
    record,
)
from benchmarks.papers.reward_quality.touch_audit import audit_touch
from touchgoal.rewards.report.tables import metrics_table
from touchgoal.runtime.option_types import Count, checked_dataclass
from touchgoal.sim_envs.config import PickPlaceConfig

TRUE_KINDS = tuple(kind for kind in KINDS if kind != "overgripped")
"""Kinds whose mean is judged. A grip of 40 N cannot be recognised where the demonstrations differ in
force."""
_ON_DIAGONAL = 8  # objects
_AUDITED = ("success", "drop", "wrong_object")


@checked_dataclass
class Config(BenchmarkOptions, Sizes):
    """Options of benchmark reward-quality."""

    encoder: str = "gelsight_mini"
    """Touch encoder, by name or folder; the simulated sensor is the encoder's."""
    every: Count = 1
    """Measure every n-th frame only: n times faster, with times that are n times coarser."""
    scenes: tuple[Scene, ...] = SCENES
    """Scenes to judge in."""
    env: PickPlaceConfig = PickPlaceConfig()
    """Options of the task; its sensor is the encoder's."""
    workers: Count = CORES
    """Processes that simulate and embed. With --out the same line continues an interrupted run."""


def run(config: Config) -> dict[str, Any]:
    """Record, embed, measure and judge."""
    with tempfile.TemporaryDirectory() as folder:
        return _run(config, config.out or Path(folder))


def _run(config: Config, folder: Path) -> dict[str, Any]:
    files = EmbeddedFiles(folder / "embedded", config.encoder, config.every)
    parts, results = [], {}
    for scene in config.scenes:
        wanted = plan(scene, config)
        recorded = record(folder / "episodes", scene, wanted, config.env, config.workers)
        files.make(recorded, config.workers)
        judge = fit_judge(files, recorded)
        results[scene], text = _judge_scene(judge, recorded)
        parts.append(f"scene: {scene}\n{text}")
    return {"table": "\n\n".join(parts), "scenes": results}


def _judge_scene(judge: Judge, recorded: Sequence[Recorded]) -> tuple[dict[str, Any], str]:
    test = [r for r in recorded if r.purpose == "test"]
    judged: dict[str, list[Judged]] = {}
    for episode in judge.judge(test):
        judged.setdefault(episode.outcome, []).append(episode)
    successes = judged["success"]
    curves = list(successes[0].costs)
    poor = [e for outcome in SUBOPTIMAL for e in judged[outcome]]
    failures = [e for kind in TRUE_KINDS for e in judged[kind]]
    found = {kind: {c: auc(successes, judged[kind], c) for c in curves} for kind in KINDS}
    found["mean of true kinds"] = {
        c: mean_of([found[kind][c] for kind in TRUE_KINDS]) for c in curves
    }
    ordered = {
        "order of quality": {c: order([successes, poor, failures], c) for c in curves},
        "success over poor success": {c: order([successes, poor], c) for c in curves},
        "success over failure": {c: order([successes, failures], c) for c in curves},
    }
    ranks = {
        outcome: {c: rank_with_time(episodes, c) for c in curves}
        for outcome, episodes in judged.items()
    }
    margins = _margins(judge, test, curves)
    audited = [r for r in test if r.outcome in _AUDITED]
    audit = audit_touch(
        [judge.files.load(r) for r in audited],
        [judge.goals[r.object] for r in audited],
        judge.curves,
    )
    text, claims = _paper(judge, [r for r in test if r.outcome == "success"], judged["never_touch"])
    text = "\n\n".join(
        [
            tables.sizes(judged, judge.normalizer.episodes),
            tables.grid("AUC of the last cost, success against each kind (0.5 is chance)", found),
            tables.grid("pairs of the same object in the right order, by the score", ordered),
            tables.grid("rank correlation of falling cost with time", ranks),
            tables.intervals(found | ordered, curves),
            tables.diagonals(margins),
            audit.table,
            text,
        ]
    )
    result = {
        "episodes": {outcome: len(episodes) for outcome, episodes in judged.items()},
        "auc": tables.as_json(found),
        "order": tables.as_json(ordered),
        "rank": tables.as_json(ranks),
        "diagonal": margins,
        "audit": {"verdict": audit.verdict, "rows": [vars(row) for row in audit.rows]},
        "claims": [vars(c) for c in claims],
        "units": judge.normalizer.unit,
    }
    return result, text


def _margins(
    judge: Judge, test: Sequence[Recorded], curves: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Return margin and share of nearest own goals of one success of each of 8 objects."""
    chosen: dict[str, Recorded] = {}
    for r in test:
        if r.outcome == "success" and len(chosen) < _ON_DIAGONAL:
            chosen.setdefault(r.object, r)
    costs = judge.to_every_goal(list(chosen.values()))
    found = {}
    for curve in curves:
        table = np.array([[episode[name][curve] for episode in costs] for name in chosen])
        margin, nearest = diagonal(table)
        found[curve] = {"margin": margin, "nearest": nearest, "objects": float(len(chosen))}
    return found


def _paper(
    judge: Judge, successes: Sequence[Recorded], untouched: Sequence[Judged]
) -> tuple[str, list[Any]]:
    """Return the tables of Figures 8 and 9, and the claims."""
    pairs = judge.to_own_end(successes)
    own, words = [a for a, _ in pairs], [b for _, b in pairs if b is not None]
    claims = judge_claims(own, words, untouched)
    lines = ["Figure 8: goal = own last frame, successes", metrics_table(own, legend=not words)]
    if words:
        lines += ["\nFigure 9: a sentence never trained on as goal of touch", metrics_table(words)]
    return "\n".join([*lines, "\nclaims", *(c.line for c in claims)]), claims
