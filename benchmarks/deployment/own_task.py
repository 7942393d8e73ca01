"""A task of one's own as `docs/own_task.md` does it, on a twin over libfranka in lock-step.

A scripted device records demonstrations of a block that goes on a disc, a policy is trained on them, and
deployed; the twin's truth, which neither reads, says whether it succeeded. What a folder of an earlier run
holds, recordings or policy, is taken from there.
"""

import json
import os
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from touchgoal.benchmarks.deployment.deployed_episode import Scene, deployed_twin
from touchgoal.benchmarks.options import BenchmarkOptions
from touchgoal.control.cell.cell_file import read_cell_file
from touchgoal.control.cell.twin_client import ask_twin
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Count, Positive, Seed, checked_dataclass
from touchgoal.runtime.progress import track

_TASK = "block on disc"
_RECORDED = {"demonstrations": seeds.TRAINING, "validation": seeds.VALIDATION}


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark own-task."""

    work: Path = Path("runs/own-task")
    """Folder of recordings, policy and deployments."""
    demonstrations: Count = 50
    """Demonstrations to train on; a tenth as many are recorded to validate on."""
    episodes: Count = 20
    """Deployments."""
    seconds: Positive = 40.0
    """Time limit of a deployment, s."""
    seed: Seed = seeds.DEPLOY_TEST.start
    """Random seed of the first deployment's scene; each further one adds one."""


@dataclass(frozen=True)
class OwnTaskRun:
    """Result of one deployment, by the twin's truth."""

    seed: int
    success: bool
    progress: float
    ending: str


def run(config: Config) -> dict[str, Any]:
    """Record, train and deploy where that is not done yet; return the table."""
    work = config.work
    work.mkdir(parents=True, exist_ok=True)
    counts = config.demonstrations, max(1, config.demonstrations // 10)
    scene = Scene("pick-place", config.seed, "wooden_block")
    with deployed_twin(scene, True, work, 0) as cell:
        for (name, drawn), count in zip(_RECORDED.items(), counts, strict=True):
            if not (work / name).exists():
                _touchgoal(
                    "record-demos", cell, "--task", _TASK, "--device", "scripted", "--seed", drawn.start,
                    "--episodes", count, "--yes", "--out", work / name,
                )  # fmt: skip
        policy = work / "policy"
        if not policy.exists():
            data, validation = (work / name / "episodes" for name in _RECORDED)
            _touchgoal(
                "train-policy", "--preset", "sight", "--data", data, "--validation", validation,
                "--out", policy,
            )  # fmt: skip
        drawn = range(config.seed, config.seed + config.episodes)
        runs = [
            _deploy(cell, policy, seed, config) for seed in track(drawn, "deploying", "deployment")
        ]
    rate = SuccessRate(sum(r.success for r in runs), len(runs))
    lines = [f"{_TASK}, {config.demonstrations} demonstrations: {rate} [95 % Wilson]"]
    lines += [f"    {r.seed}: progress {r.progress:.2f}, {r.ending}" for r in runs if not r.success]
    return {"table": "\n".join(lines), "runs": [asdict(r) for r in runs]}


def _deploy(cell: Path, policy: Path, seed: int, config: Config) -> OwnTaskRun:
    table = json.loads(cell.read_text())
    table["task"]["seconds"] = config.seconds
    cell.write_text(json.dumps(table))
    out = config.work / "deployments" / str(seed)
    done = _start(
        "deploy", cell, "--task", _TASK, "--policy", policy, "--execute", "--yes", "--seed", seed,
        "--out", out,
    )  # fmt: skip
    if not (out / "metrics.json").exists():  # the twin still has the scene before
        return OwnTaskRun(seed, False, 0.0, f"refused: {' '.join(done.stderr.split())[-300:]}")
    truth = ask_twin(read_cell_file(cell).task.twin, "truth")
    ending = ([line for line in done.stderr.splitlines() if line] or ["done"])[-1]
    return OwnTaskRun(seed, truth["success"], truth["progress"], ending)


def _touchgoal(*arguments: object) -> None:
    """Run a command that must succeed; UserError with its last line if it does not."""
    done = _start(*arguments)
    if done.returncode:
        raise UserError(f"{arguments[0]}: {' '.join(done.stderr.split())[-300:]}")


def _start(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "touchgoal.launch", *map(str, arguments)]
    env = {**os.environ, "OMP_NUM_THREADS": str(os.cpu_count() or 1)}
    return subprocess.run(command, capture_output=True, text=True, env=env, check=False)
