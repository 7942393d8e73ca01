"""Choice of a training's best snapshot by trials in the task, because the loss does not show it."""

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

from touchgoal.policies.checkpoint import SavedPolicy
from touchgoal.policies.evaluation.evaluate import Evaluation, run_trials, trial_specs
from touchgoal.policies.training.train import POLICY, SNAPSHOTS
from touchgoal.runtime import seeds
from touchgoal.runtime.parallel.parallel_map import Workers
from touchgoal.sim_envs.config import TaskConfig

Score = tuple[float, float]  # success rate, then mean progress; both in [0, 1]


def select(
    run: Path, parts: Mapping[str, Path], trial: Callable[[Path], Score]
) -> dict[str, Score]:
    """Try every snapshot of a run on validation tasks, and make the best one its policy.

    `parts` are the folders beside every policy, see `copy_parts`. Returns the score of every
    snapshot; among equals the later one wins.
    """
    scores: dict[str, Score] = {}
    for snapshot in sorted((run / SNAPSHOTS).iterdir()):
        copy_parts(snapshot, parts)
        success, progress = scores[snapshot.name] = trial(snapshot)
        print(f"{snapshot.name}: success {success:.0%}, progress {progress:.0%}")
    best = max(scores, key=lambda name: (scores[name], name))
    shutil.rmtree(run / POLICY, ignore_errors=True)
    shutil.copytree(run / SNAPSHOTS / best, run / POLICY)
    return scores


def score(policy: Path, env: TaskConfig, trials: int, workers: Workers) -> Score:
    """Return how well the policy in a folder does in a number of trials that choose a snapshot."""
    maker = SavedPolicy(policy)
    env = maker().env_config(env)
    start = seeds.MODEL_SELECTION.first(trials, "--trials")
    result = Evaluation(tuple(run_trials(env, maker, trial_specs(env, trials, start), workers)))
    return result.rate.successes / trials, result.progress


def copy_parts(policy: Path, parts: Mapping[str, Path]) -> None:
    """Copy folders beside a policy's weights, by name: its touch encoder, its pose estimator."""
    for name, folder in parts.items():
        shutil.copytree(folder, policy / name, dirs_exist_ok=True)
