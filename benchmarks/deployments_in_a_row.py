"""Many deployments on one twin of each task, in turn: is any refused for what the last left behind?

And is there more of a twin at the end than after the second of all deployments: threads, files, processes,
memory?
"""

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

_BASE = 2  # deployments after which everything is loaded that ever will be
_THINGS: dict[TaskName, str] = {"pick-place": "wooden_block", "bead-maze": "helix-3"}


def run_in_a_row(config: DeployOptions) -> dict[str, Any]:
    """What came of each, and by how much the twins have grown since the second."""
    arm = "lock-step" if "lock-step" in config.arms else "real-time"
    done: list[Deployment] = []
    footprints: list[dict[TaskName, Footprint]] = []
    with ExitStack() as undo:
        folder = Path(undo.enter_context(tempfile.TemporaryDirectory()))
        twins: dict[TaskName, DeployedTwin] = {
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
            footprints.append({name: twin.footprint() for name, twin in twins.items()})
            print(_line(k, done[-1], footprints[-1][task]), flush=True)
    refused = sum(row.ending.startswith("refused") for row in done)
    lines = [f"{len(done)} deployments in a row, {arm}: {refused} refused"]
    base = min(_BASE, len(done)) - 1
    lines += [
        f"the twin of {task}: {_growth(footprints[base][task], footprints[-1][task])} from after "
        f"deployment {base + 1} to after {len(done)}"
        for task in config.tasks
    ]
    kept = [{task: asdict(print_) for task, print_ in each.items()} for each in footprints]
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


def _growth(first: Footprint, last: Footprint) -> str:
    return (
        f"{last.threads - first.threads:+d} threads, {last.files - first.files:+d} files, "
        f"{last.children - first.children:+d} processes, {(last.memory - first.memory) / 1e6:+.1f} MB"
    )
