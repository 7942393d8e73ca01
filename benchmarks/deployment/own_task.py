"""A task of one's own as `docs/own_task.md` does it, on a twin over libfranka in lock-step.

A scripted device records demonstrations of a block that goes on a disc, a policy is trained on them, and
deployed; the twin's truth, which neither reads, says whether it succeeded. What a folder of an earlier run
holds, recordings or policy, is taken from there.
"""

import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.deployment.deployed_episode import REFUSED, Deployment, Scene, deploy, deployed_twin
from benchmarks.options import BenchmarkOptions
from touchgoal.control.cell.cell_file import read_cell_file
from touchgoal.control.cell.twin_client import ask_twin
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.policies.training.train import POLICY
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Count, Positive, Seed, checked_dataclass
from touchgoal.runtime.progress import track

TASK, OBJECT = "block on disc", "wooden_block"
_RECORDED = {"demonstrations": seeds.TRAINING, "validation": seeds.VALIDATION}


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark own-task."""

    work: Path = Path("runs/own-task")
    """Folder of recordings and policy."""
    demonstrations: Count = 50
    """Demonstrations to train on; a tenth as many are recorded to validate on."""
    episodes: Count = 20
    """Deployments."""
    seconds: Positive = 40.0
    """Time limit of a deployment, s."""
    seed: Seed = seeds.DEPLOY_TEST.start
    """Random seed of the first deployment's scene; each further one adds one."""


def run(config: Config) -> dict[str, Any]:
    """Record, train and deploy where that is not done yet; return the table."""
    work = config.work
    work.mkdir(parents=True, exist_ok=True)
    counts = config.demonstrations, max(1, config.demonstrations // 10)
    scene = Scene("pick-place", config.seed, OBJECT)
    with TemporaryDirectory() as name, deployed_twin(scene, True, Path(name), 0) as cell:
        data, validation = demonstrate(cell, work, counts)
        policy = work / "policy"
        if not (policy / POLICY).exists():
            touchgoal(
                "train-policy", "--preset", "sight", "--data", data, "--validation", validation,
                "--out", policy,
            )  # fmt: skip
        drawn = range(config.seed, config.seed + config.episodes)
        rows = [
            _deploy(cell, policy, seed, config) for seed in track(drawn, "deploying", "deployment")
        ]
    rate = SuccessRate(sum(row.success for row in rows), len(rows))
    lines = [f"{TASK}, {config.demonstrations} demonstrations: {rate} [95 % Wilson]"]
    lines += [
        f"    {r.seed}: progress {r.progress or 0:.2f}, {r.ending}" for r in rows if not r.success
    ]
    return {"table": "\n".join(lines), "deployments": [asdict(row) for row in rows]}


def demonstrate(cell: Path, work: Path, counts: tuple[int, int]) -> tuple[Path, Path]:
    """Record demonstrations to train and to validate on, unless the folder has them; return both sets."""
    for (kind, drawn), count in zip(_RECORDED.items(), counts, strict=True):
        if not (work / kind).exists():
            touchgoal(
                "record-demos", cell, "--task", TASK, "--device", "scripted", "--seed", drawn.start,
                "--episodes", count, "--yes", "--out", work / kind,
            )  # fmt: skip
        if (held := len(EpisodeSet(work / kind / "episodes"))) < count:
            raise UserError(f"{work / kind} holds {held} of {count} recordings: remove it")
    data, validation = (work / kind / "episodes" for kind in _RECORDED)
    return data, validation


def _deploy(cell: Path, policy: Path, seed: int, config: Config) -> Deployment:
    scene, out = Scene("pick-place", seed, OBJECT), cell.parent / str(seed)
    done = deploy(cell, scene, str(policy), "lock-step", config.seconds, out, TASK)
    if done.ending.startswith(REFUSED):  # the twin still has the scene before
        return done
    truth = ask_twin(read_cell_file(cell).task.twin, "truth")
    return replace(done, success=truth["success"], progress=truth["progress"])


def touchgoal(*arguments: object) -> None:
    """Run a command; UserError with the end of what it says if it fails."""
    command = [sys.executable, "-m", "touchgoal.launch", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise UserError(f"{arguments[0]}: {' '.join(done.stderr.split())[-300:]}")
