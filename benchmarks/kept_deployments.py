"""Deployments that have ended, in a file that outlives a benchmark that is stopped."""

import json
from dataclasses import asdict
from pathlib import Path

from touchgoal.benchmarks.deployed_episode import Deployment, Scene
from touchgoal.runtime.provenance import provenance

_Key = tuple[str, str, str, int, str]


class KeptDeployments:
    """`deployments.jsonl` of a run's folder: a line for each deployment, written as it ends.

    Those of the same code count; of a tree with changes that are not committed nobody knows, so they do not.

    Args:
        folder: of the run; None keeps them in memory alone.
    """

    def __init__(self, folder: Path | None) -> None:
        said = provenance()
        self._code = {key: said[key] for key in ("touchgoal", "commit", "dirty")}
        self._file = None if folder is None else folder / "deployments.jsonl"
        self._found: dict[_Key, Deployment] = {}
        if self._file is None or not self._file.exists():
            return
        whole = [line for line in self._file.read_text().splitlines(True) if line.endswith("\n")]
        self._file.write_text("".join(whole))  # without what was being written when it was stopped
        for kept in map(json.loads, whole):
            if kept.pop("code") == self._code and not said["dirty"]:
                self._remember(Deployment(**kept))

    def find(self, scene: Scene, policy: str, arm: str) -> Deployment | None:
        """The one of that scene, policy and arm, if it has ended."""
        return self._found.get((scene.task, policy, arm, scene.seed, scene.thing))

    def add(self, deployment: Deployment) -> None:
        """Keep one that has ended."""
        self._remember(deployment)
        if self._file is not None:
            with self._file.open("a") as file:
                file.write(json.dumps({"code": self._code, **asdict(deployment)}) + "\n")

    def _remember(self, done: Deployment) -> None:
        self._found[done.task, done.policy, done.arm, done.seed, done.thing] = done
