"""Table of trials: success by shape of object or family of wires, and failures."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from touchgoal.control.tactile.light_gain import light_advice
from touchgoal.policies.evaluation.evaluate import Evaluation, Trial
from touchgoal.sim_envs.scene.objects import SHAPES
from touchgoal.sim_envs.scene.wires import FAMILIES

_MUCH_CLAMPED = 0.05  # share of the ticks


def table(trials: Sequence[Trial]) -> str:
    """Return the table with its legend; the goal error only where the task has a goal position."""
    placed = any(t.goal_distance is not None for t in trials)
    lines = [
        f"{'':<12}{'success [95 % Wilson]':<24}{'progress':>9}{'force N, mean':>15}{'max':>7}"
        f"{'seconds':>9}" + f"{'goal error mm':>15}" * placed
    ]
    for group in (*SHAPES, *FAMILIES, "all"):
        some = [t for t in trials if group in (group_of(t), "all")]
        if some:
            lines.append(_row(group, some, placed))
    lines.append("progress: greatest share of the task done; force: external, on the hand")
    if placed:
        lines.append("goal error: distance of the object from its goal at the end")
        episodes = [t.episode for t in trials]
        masses, forces = [e["mass"] for e in episodes], [e["grasp_force"] for e in episodes]
        lines.append(
            f"objects of {1e3 * min(masses):.0f} to {1e3 * max(masses):.0f} g, gripped with "
            f"{min(forces):.1f} to {max(forces):.1f} N"
        )
    failures = Counter(t.failure for t in trials if t.failure)
    lines.append("failures: " + (", ".join(f"{k} {n}" for k, n in failures.items()) or "none"))
    if (clamped := np.mean([t.clamped for t in trials])) > _MUCH_CLAMPED:
        lines.append(
            f"clamped: {clamped:.0%} of the actions are beyond the arm's limits; an action is the "
            "joint changes of one tick (rad) and the gripper's width (m)"
        )
    if advice := light_advice([t.light_change for t in trials]):
        lines.append(f"light: {advice}")
    return "\n".join(lines)


def group_of(trial: Trial) -> str:
    """Return the family of the trial's wire, or the shape of its object."""
    return str(trial.episode.get("family") or trial.episode["shape"])


def worst_first(trials: Sequence[Trial]) -> list[int]:
    """Return indices of the trials, ranked by progress, then by distance from the goal or force."""
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
        f"{group:<12}{result.rate!s:<24}{result.progress:>9.0%}"
        f"{np.mean([t.mean_force for t in some]):>15.1f}{max(t.peak_force for t in some):>7.1f}"
        f"{np.mean([t.seconds for t in some]):>9.1f}"
    )
    if placed:
        row += f"{1e3 * np.mean([t.goal_distance or 0.0 for t in some]):>15.1f}"
    return row
