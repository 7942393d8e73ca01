"""Many deployments on one twin of each task, in turn: is any refused for what the last left behind?"""

import tempfile
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

from touchgoal.benchmarks.config import DeployOptions
from touchgoal.benchmarks.deployed_episode import Deployment, Scene, deploy, limited
from touchgoal.benchmarks.deployed_twin import DeployedTwin, Footprint
from touchgoal.policies.by_name import scripted
from touchgoal.sim_envs.config import TaskName

_THINGS: dict[TaskName, str] = {"pick-place": "wooden_block", "bead-maze": "helix-3"}


def run_in_a_row(config: DeployOptions) -> dict[str, Any]:
    """What came of each, and by how much the twins have grown since their first one."""
    arm = "lock-step" if "lock-step" in config.arms else "real-time"
    done: list[Deployment] = []
    prints: dict[TaskName, list[Footprint]] = {task: [] for task in config.tasks}
    with ExitStack() as undo:
        folder = Path(undo.enter_context(tempfile.TemporaryDirectory()))
        twins = {
            task: undo.enter_context(_twin(task, config.seed, arm, folder / task, i))
            for i, task in enumerate(config.tasks)
        }
        for k in range(config.in_a_row):
            task = config.tasks[k % len(config.tasks)]
            own = config.policies[k // len(config.tasks) % len(config.policies)]
            policy = scripted(task) if own == "scripted" else own
            scene = Scene(task, config.seed + k, _THINGS[task])
            done.append(
                deploy(
                    limited(twins[task].cell_file, config.seconds),
                    scene,
                    policy,
                    arm,
                    folder / f"run_{k}",
                )
            )
            prints[task].append(twins[task].footprint())
            print(_line(k, done[-1], prints[task][-1]), flush=True)
    refused = sum(row.ending.startswith("refused") for row in done)
    lines = [f"{len(done)} deployments in a row, {arm}: {refused} refused"]
    lines += [f"the twin of {task}: {_growth(p)}" for task, p in prints.items() if p]
    kept = {task: [asdict(p) for p in found] for task, found in prints.items()}
    return {
        "table": "\n".join(lines),
        "refused": refused,
        "deployments": [asdict(row) for row in done],
        "footprints": kept,
    }


def _twin(task: TaskName, seed: int, arm: str, folder: Path, number: int) -> DeployedTwin:
    folder.mkdir()
    twin = DeployedTwin(task, seed, _THINGS[task], arm == "lock-step", folder, number)
    return twin


def _line(k: int, row: Deployment, has: Footprint) -> str:
    return (
        f"{k + 1:>3} {row.task}, {row.policy}: {row.ending} ({row.seconds:.1f} s); its twin has "
        f"{has.threads} threads, {has.files} files, {has.children} processes, {has.memory / 1e6:.0f} MB"
    )


def _growth(found: list[Footprint]) -> str:
    first, last = found[0], found[-1]
    return (
        f"{last.threads - first.threads:+d} threads, {last.files - first.files:+d} files, "
        f"{last.children - first.children:+d} processes, {(last.memory - first.memory) / 1e6:+.1f} MB "
        f"from the first to the last of {len(found)}"
    )
