"""Which snapshot of a training acts best: only trials can tell, a loss cannot."""

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

from touchgoal.policies.training.train import POLICY, SNAPSHOTS

Score = tuple[float, float]
"""Success rate, then mean progress; both in [0, 1]."""


def select(
    run: Path, parts: Mapping[str, Path], trial: Callable[[Path], Score]
) -> dict[str, Score]:
    """Tries every snapshot of a run and makes the best one its policy.

    Args:
        run: directory of a finished training.
        parts: what goes beside every policy, see `add_parts`.
        trial: scores a policy's directory, on validation tasks.

    Returns:
        The score of every snapshot; the best is in `run/policy`. Among equals the later one wins.
    """
    scores: dict[str, Score] = {}
    for snapshot in sorted((run / SNAPSHOTS).iterdir()):
        add_parts(snapshot, parts)
        scores[snapshot.name] = trial(snapshot)
        print(
            f"{snapshot.name}: success {scores[snapshot.name][0]:.0%}, "
            f"progress {scores[snapshot.name][1]:.0%}"
        )
    best = max(scores, key=lambda name: (scores[name], name))
    shutil.rmtree(run / POLICY, ignore_errors=True)
    shutil.copytree(run / SNAPSHOTS / best, run / POLICY)
    return scores


def add_parts(policy: Path, parts: Mapping[str, Path]) -> None:
    """Copies folders beside a policy's weights: its touch encoder, its senses, by their names."""
    for name, folder in parts.items():
        shutil.copytree(folder, policy / name, dirs_exist_ok=True)
