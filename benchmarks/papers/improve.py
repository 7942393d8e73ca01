"""A task of one's own from few demonstrations, improved by its own runs over the wire, as `touchgoal improve` does it.

A scripted device leads the arm of a twin to put a block on a disc; a policy learns it by sight, runs, and is
trained on what is accepted as well: by a judge that is fitted on the demonstrations alone, by the twin's
truth, or all of it. The judge ends the runs, whatever accepts them. The first round's runs are the same in all,
and say how good the policy was before. What the folder of an earlier run holds is taken from there.
"""

import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

import numpy as np

from benchmarks.deployment.deployed_episode import REFUSED, Scene, deploy, deployed_twin
from benchmarks.deployment.own_task import OBJECT, TASK, demonstrate, touchgoal
from benchmarks.options import CORES, BenchmarkOptions
from touchgoal.control.cell.cell_file import read_cell_file
from touchgoal.control.cell.twin_client import ask_twin
from touchgoal.episodes.outcomes.judged import JudgedOutcome, write_judged
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch.improve import judge_set, train_accepted
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.policies.training.improve import Improvement
from touchgoal.rewards.judging.judge import JUDGE
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.json_file import parse_json, write_json
from touchgoal.runtime.option_types import Count, Positive, checked_dataclass

Filter = Literal["judge", "truth", "none"]
_TRIED = seeds.DEPLOY_TEST.start + 500_000  # scenes of the trials
_TRUTH = "truth.json"  # of the runs of a folder, in their order; no training reads it


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark improve."""

    filters: tuple[Filter, ...] = get_args(Filter)
    """What accepts runs: a judge fitted on the demonstrations, the twin's truth, or nothing (all are)."""
    demonstrations: Count = 15
    """Demonstrations; a fifth as many are recorded to validate on."""
    rounds: Count = 3
    """Rounds of runs and training."""
    runs: Count = 20
    """Runs in each round; as many deployments on other scenes try each policy in the end."""
    seconds: Positive = 30.0
    """Time limit of a run, s."""
    train: str = "--preset sight"
    """Options of train-policy."""
    workers: Count = CORES
    """Twins side by side."""


@dataclass(frozen=True)
class _Lab:
    """Runs, trainings and trials of one filter, on a twin of its own."""

    config: Config
    out: Path
    number: int  # of the twin

    @contextmanager
    def twin(self) -> Iterator[Path]:
        scene = Scene("pick-place", _TRIED, OBJECT)
        with (
            TemporaryDirectory() as name,
            deployed_twin(scene, True, Path(name), self.number) as cell,
        ):
            if self.judge.is_dir():
                table = parse_json(cell.read_bytes())
                table["task"]["judge"] = str(self.judge.resolve())
                write_json(cell, table)
            yield cell

    @property
    def judge(self) -> Path:
        """Folder of the judge, which ends the runs of all filters; it is fitted on the demonstrations."""
        return self.out.resolve() / "judge-fit"

    def run(self, policy: Path, seeds_: range, out: Path) -> Iterator[bool]:
        """Deploy a policy in scenes, its episodes into `out`; yield the twin's truth of each."""
        with self.twin() as cell:
            for seed in seeds_:
                scene = Scene("pick-place", seed, OBJECT)
                what = cell, scene, str(policy), "lock-step", self.config.seconds, out, TASK
                run = deploy(*what)
                # nothing has moved: on a loaded machine a device may be late
                run = deploy(*what) if run.ending.startswith(REFUSED) else run
                if run.ending.startswith(REFUSED):
                    raise UserError(run.ending)
                yield bool(ask_twin(read_cell_file(cell).task.twin, "truth")["success"])

    def record(self, policy: Path, root: Path, numbers: range) -> None:
        """Append runs to a set, and their truth to a file beside it."""
        file = root.parent / _TRUTH
        known = parse_json(file.read_bytes())[: numbers.start] if file.exists() else []
        first = seeds.IMPROVEMENT.start
        drawn = range(first + numbers.start, first + numbers.stop)
        for true in self.run(policy, drawn, root.parent):
            known.append(true)
            write_json(file, known)

    def success(self, policy: Path, twins: int) -> SuccessRate:
        """Return the success of a policy in the trials, which several twins share."""
        file, last = policy.parent / "trials.json", _TRIED + self.config.runs

        def tried(k: int) -> list[bool]:
            lab = replace(self, number=self.number + len(get_args(Filter)) * k)
            with TemporaryDirectory() as name:
                return list(lab.run(policy, range(_TRIED + k, last, twins), Path(name)))

        if not file.exists():
            with ThreadPoolExecutor(twins) as pool:
                write_json(file, [true for of in pool.map(tried, range(twins)) for true in of])
        true = parse_json(file.read_bytes())
        return SuccessRate(sum(true), len(true))

    def label(self, name: Filter, data: Path, episodes: EpisodeSet) -> dict[int, JudgedOutcome]:
        """Return what a filter says of demonstrations and runs."""
        if name == "judge":
            return judge_set(str(self.judge), episodes)
        if name == "none":
            return everything(episodes)
        true = [True] * len(EpisodeSet(data)) + parse_json((self.out / name / _TRUTH).read_bytes())
        return {i: JudgedOutcome("success" if t else "failure") for i, t in enumerate(true)}

    def overrule(self, name: Filter, data: Path) -> None:
        """Replace the judge's verdicts, which runs carry since the judge ends them, by those of the filter."""
        if name != "judge":
            episodes = EpisodeSet(self.out / name / "episodes")
            write_judged(episodes, self.label(name, data, episodes))

    def improve(self, name: Filter, data: Path, validation: Path) -> Improvement:
        """Return what goes through rounds with a filter; no round is done yet."""

        def record(policy: Path, root: Path, numbers: range) -> None:
            self.record(policy, root, numbers)
            self.overrule(name, data)

        label = partial(self.label, name, data)
        train = partial(train_accepted, validation, self.config.train)
        return Improvement(self.out / name, data, self.config.runs, record, label, train)


def run(config: Config) -> dict[str, Any]:
    """Record, improve by each filter, try the policies."""
    with TemporaryDirectory() as folder:
        return _run(config, config.out or Path(folder))


def _run(config: Config, out: Path) -> dict[str, Any]:
    lab = _Lab(config, out, 0)
    with lab.twin() as cell:
        counts = config.demonstrations, max(1, config.demonstrations // 5)
        data, validation = demonstrate(cell, out, counts)
    if not (lab.judge / JUDGE).exists():
        shutil.rmtree(lab.judge, ignore_errors=True)
        touchgoal("fit-normalizer", data, "--value", "--judge", "--out", lab.judge)
    first = lab.improve("none", data, validation)
    for _ in first.rounds(0):
        pass
    root = first.out / "episodes"
    if (done := len(EpisodeSet(root)) - len(EpisodeSet(data))) < config.runs:
        lab.record(first.policy(0), root, range(done, config.runs))
    for name in config.filters:
        go_on_from(first.out, out / name)
    for name in config.filters:
        lab.overrule(name, data)

    twins = max(1, config.workers // len(config.filters))

    def improved(job: tuple[int, Filter]) -> dict[str, Any]:
        own = _Lab(config, out, 1 + job[0])
        work = own.improve(job[1], data, validation)
        said = [v for done in work.rounds(config.rounds) for v in done.verdicts]
        true = parse_json((work.out / _TRUTH).read_bytes())
        accepted = [t for t, v in zip(true, said, strict=True) if v == "success"]
        return {
            "successes": own.success(work.policy(config.rounds), twins).successes,
            "accepted": len(accepted),
            "right": float(np.mean(accepted)) if accepted else 0.0,
            "rounds": [sum(true[i : i + config.runs]) for i in range(0, len(true), config.runs)],
        }

    with ThreadPoolExecutor(config.workers) as pool:
        rows = dict(zip(config.filters, pool.map(improved, enumerate(config.filters)), strict=True))
    before = SuccessRate(next(iter(rows.values()))["rounds"][0], config.runs)
    lines = [
        f"{config.demonstrations} demonstrations, {config.rounds} rounds of {config.runs} runs; "
        "success of policies in trials [95 % Wilson]",
        f"{'filter':<8}{'success':>22}{'accepted':>10}{'of them right':>15}  right runs by round",
        f"{'before':<8}{before!s:>22}",
    ]
    for name, row in rows.items():
        after, each = (
            SuccessRate(row["successes"], config.runs),
            " ".join(map(str, row["rounds"])),
        )
        lines.append(f"{name:<8}{after!s:>22}{row['accepted']:>10}{row['right']:>15.0%}  {each}")
    found = {"before": [{"successes": before.successes}]} | {k: [v] for k, v in rows.items()}
    return {"table": "\n".join(lines), "trials": config.runs, "imitation": found}


def go_on_from(first: Path, folder: Path) -> None:
    """Begin a filter's rounds with a copy of what all share, unless it has begun."""
    if folder.exists():
        return
    unfinished = folder.with_name("unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    shutil.copytree(first, unfinished)
    unfinished.rename(folder)


def everything(episodes: EpisodeSet) -> dict[int, JudgedOutcome]:
    """Accept all episodes of a set."""
    return {i: JudgedOutcome("success") for i in range(len(episodes))}
