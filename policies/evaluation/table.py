"""A table of trials: success by kind of object or wire and in all, and what went wrong."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from touchgoal.policies.evaluation.evaluate import Evaluation, Trial
from touchgoal.sim_envs.scene.objects import SHAPES
from touchgoal.sim_envs.scene.wires import FAMILIES


def table(trials: Sequence[Trial]) -> str:
    """Success with its interval, progress, forces on the hand; placing error where there is a goal."""
    placed = any(t.goal_distance is not None for t in trials)
    lines = [
        f"{'':<12}{'success [95 % Wilson]':<24}{'completed':>10}{'mean force N':>14}"
        f"{'peak force N':>14}{'seconds':>9}" + f"{'off goal mm':>13}" * placed
    ]
    for group in (*SHAPES, *FAMILIES, "all"):
        some = [t for t in trials if group in (group_of(t), "all")]
        if some:
            lines.append(_row(group, some, placed))
    if placed:
        episodes = [t.episode for t in trials]
        masses, forces = [e["mass"] for e in episodes], [e["grasp_force"] for e in episodes]
        lines.append(
            f"masses {1e3 * min(masses):.0f} to {1e3 * max(masses):.0f} g, "
            f"grasp forces {min(forces):.1f} to {max(forces):.1f} N"
        )
    failures = Counter(t.failure for t in trials if t.failure)
    lines.append("failures: " + (", ".join(f"{k} {n}" for k, n in failures.items()) or "none"))
    return "\n".join(lines)


def group_of(trial: Trial) -> str:
    """Family of the trial's wire, or shape of its object."""
    return str(trial.episode.get("family") or trial.episode["shape"])


def worst_first(trials: Sequence[Trial]) -> list[int]:
    """Indices of the trials, by progress, then by distance from the goal or by force."""
    return sorted(
        range(len(trials)),
        key=lambda i: (
            trials[i].success,
            trials[i].progress,
            -(trials[i].goal_distance or 0.0),
            -trials[i].peak_force,
        ),
    )


def _row(group: str, some: list[Trial], placed: bool) -> str:
    result = Evaluation(tuple(some))
    row = (
        f"{group:<12}{result.rate!s:<24}{result.progress:>10.0%}"
        f"{np.mean([t.mean_force for t in some]):>14.1f}{max(t.peak_force for t in some):>14.1f}"
        f"{np.mean([t.seconds for t in some]):>9.1f}"
    )
    if placed:
        row += f"{1e3 * np.mean([t.goal_distance or 0.0 for t in some]):>13.1f}"
    return row
