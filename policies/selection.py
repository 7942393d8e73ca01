"""Which snapshot of a training acts best: only trials can tell, a loss cannot."""

import shutil
from collections.abc import Callable
from pathlib import Path

from touchgoal.policies import checkpoint
from touchgoal.policies.train import POLICY, SNAPSHOTS

Score = tuple[float, float]
"""Success rate, then mean progress; both in [0, 1]."""


def select(run: Path, touch: Path | None, trial: Callable[[Path], Score]) -> dict[str, Score]:
    """Tries every snapshot of a run and makes the best one its policy.

    Args:
        run: directory of a finished training.
        touch: folder of the touch encoder, which is put beside every policy.
        trial: scores a policy's directory, on validation tasks.

    Returns:
        The score of every snapshot; the best is in `run/policy`. Among equals the later one wins.
    """
    scores: dict[str, Score] = {}
    for snapshot in sorted((run / SNAPSHOTS).iterdir()):
        add_touch(snapshot, touch)
        scores[snapshot.name] = trial(snapshot)
        print(
            f"{snapshot.name}: success {scores[snapshot.name][0]:.0%}, "
            f"progress {scores[snapshot.name][1]:.0%}"
        )
    best = max(scores, key=lambda name: (scores[name], name))
    shutil.rmtree(run / POLICY, ignore_errors=True)
    shutil.copytree(run / SNAPSHOTS / best, run / POLICY)
    return scores


def add_touch(policy: Path, touch: Path | None) -> None:
    """Puts the touch encoder beside a policy's weights."""
    if touch:
        shutil.copytree(touch, policy / checkpoint.TOUCH, dirs_exist_ok=True)
