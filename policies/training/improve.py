"""Improvement of a policy by its own runs: it runs, a judge labels, it is trained on what was accepted.

Filtered behaviour cloning, round after round. Demonstrations and runs lie in one episode set with its
`judged.json`; each training begins with fresh weights, on all that was accepted so far. No decision reads what
a simulator knows: success ends no run and chooses nothing; it is printed beside the judge's verdicts.
"""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.figure import Figure

from touchgoal.control import features as ft
from touchgoal.control.interfaces import Actor
from touchgoal.episodes.outcomes.judged import JudgedOutcome, read_judged, write_judged
from touchgoal.episodes.recording import EpisodeSpec, collect
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies.by_name import choose_policy
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.policies.training.train import POLICY
from touchgoal.policies.training.training_data import choose_episodes
from touchgoal.runtime import seeds
from touchgoal.runtime.json_file import write_json
from touchgoal.runtime.parallel.parallel_map import Workers
from touchgoal.sim_envs.config import TASKS, PickPlaceConfig, TaskConfig, TaskName

HEAD = f"{'round':<6}{'judged success':>22}{'true success':>22}{'unsure':>8}"
"""Head of a table of rounds."""
_EPISODES, _TRAINED = "episodes", "trained.json"  # the set; what marks a finished training
_REST = 1.0  # s recorded after a run, in which things come to rest


@dataclass(frozen=True)
class Round:
    """Runs of one policy: the judge's verdicts, and the simulator's if there is one."""

    number: int
    verdicts: list[str]
    true: list[bool] | None

    @property
    def rates(self) -> dict[str, SuccessRate]:
        """Success rate as judged, and the true one if it is known."""
        n = len(self.verdicts)
        rates = {"judged": SuccessRate(self.verdicts.count("success"), n)}
        return rates if self.true is None else rates | {"true": SuccessRate(sum(self.true), n)}

    def __str__(self) -> str:
        columns = [*map(str, self.rates.values()), ""][:2]
        return f"{self.number:<6}{columns[0]:>22}{columns[1]:>22}{self.verdicts.count('unsure'):>8}"


@dataclass(frozen=True)
class Improvement:
    """A set of demonstrations and runs, what records, labels and trains, and what is done of it."""

    out: Path
    data: Path  # the demonstrations
    runs: int  # in each round
    # appends the runs of these numbers, by the policy in the first folder, to the set in the second
    record: Callable[[Path, Path, range], None]
    label: Callable[[EpisodeSet], Mapping[int, JudgedOutcome]]
    # trains on the accepted episodes; the folder may hold an interrupted training
    train: Callable[[Path, Path], None]

    def rounds(self, count: int, policy: Path | None = None) -> Iterator[Round]:
        """Run, label and train; yield each round once its training is done. What is done is skipped.

        `policy` is the first one; default: trained on the demonstrations, in `round-0/`. UserError:
        no demonstration succeeded.
        """
        root, first = self.out / _EPISODES, len(EpisodeSet(self.data))
        if not root.exists():
            self._copy_demonstrations(root)
        policy = policy or self._trained(0)
        for number in range(1, count + 1):
            done, end = len(EpisodeSet(root)) - first, number * self.runs
            if done < end:
                self.record(policy, root, range(done, end))
            episodes, rows = EpisodeSet(root), range(first + end - self.runs, first + end)
            if missing := sorted(set(rows) - read_judged(episodes).keys()):
                found = self.label(episodes)
                write_judged(episodes, {i: found[i] for i in missing})
            judged, policy = read_judged(episodes), self._trained(number)
            yield Round(number, [judged[i].verdict for i in rows], true_outcomes(episodes, rows))

    def policy(self, number: int) -> Path:
        """Return the folder of the policy that a round ends with."""
        return self.out / f"round-{number}" / POLICY

    def _copy_demonstrations(self, root: Path) -> None:
        """Copy them with their judged outcomes; else the demonstrator's word counts."""
        copy = self.out / "unfinished"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(self.data, copy)
        episodes = EpisodeSet(copy)
        good, judged = choose_episodes(episodes).rows, read_judged(episodes)
        told = set(range(len(episodes))) - judged.keys()
        said = {i: JudgedOutcome("success" if i in good else "failure", "person") for i in told}
        write_judged(episodes, said)
        copy.rename(root)

    def _trained(self, number: int) -> Path:
        folder = self.policy(number).parent
        if not (folder / _TRAINED).exists():
            self.train(self.out / _EPISODES, folder)
            write_json(folder / _TRAINED, {})
        return folder / POLICY


def true_outcomes(episodes: EpisodeSet, rows: Sequence[int]) -> list[bool] | None:
    """Return the simulator's verdicts, for the report alone; None where there is no simulator."""
    key = ft.TRUTH_SUCCESS
    if key not in episodes.features:
        return None
    return [bool(episodes.read(i, [key]).frames[key][-1, 0]) for i in rows]


def plot_rounds(rounds: Sequence[Round]) -> Figure:
    """Return a figure of the success rates over rounds, with their intervals."""
    figure, numbers = Figure(figsize=(6.0, 4.0), dpi=100), [r.number for r in rounds]
    axes = figure.add_subplot()
    for name in rounds[0].rates:
        rates = [r.rates[name] for r in rounds]
        mean = np.array([rate.successes / rate.trials for rate in rates])
        off = np.abs(np.array([rate.interval for rate in rates]).T - mean)
        axes.errorbar(numbers, mean, off, marker="o", capsize=4, label=name)
    axes.set(xlabel="round", ylabel="success [95 % Wilson]", ylim=(0, 1), xticks=numbers)
    axes.legend(frameon=False)
    return figure


def acts_alone(make: Callable[[Any], Actor], env: Any, spec: EpisodeSpec) -> tuple[Actor, Actor]:
    """Return a policy in both `Roles` of `episodes/recording.py`: its own actions are recorded."""
    actor = make(env)
    return actor, actor


def record_simulated(
    env: TaskConfig, workers: Workers, policy: Path, root: Path, numbers: range
) -> None:
    """Record runs of a policy in simulation, for an `Improvement`."""
    options, first = env.reset_options(), seeds.IMPROVEMENT.start
    specs = [EpisodeSpec(first + i, options=options[i % len(options)]) for i in numbers]
    collect(root, env, specs, workers, partial(acts_alone, choose_policy(policy, env)[0]))


def simulation_of(demonstrations: EpisodeSet) -> TaskConfig | None:
    """Return the simulated task with the demonstrations' objects, cameras and sensor.

    Success ends none of its episodes. None if no simulator knows the task.
    """
    metas = [demonstrations.meta(i) for i in range(len(demonstrations))]
    task, features = str(metas[0].get("task")), demonstrations.features
    if task not in TASKS:
        return None
    cameras = [key for key in ft.CAMERAS if key in features]
    env = replace(
        TASKS[cast(TaskName, task)](),
        cameras=tuple(key.removeprefix(ft.IMAGE_PREFIX) for key in cameras),
        tactile=ft.TACTILE[0] in features,
        control_hz=demonstrations.fps,
        sensor=str(metas[0]["sensor"]),
        rest=_REST,
        ends_by_success=False,
    )
    for key in cameras:
        env = replace(env, camera_size=tuple(features[key]["shape"][:2]))
    if isinstance(env, PickPlaceConfig):
        env = replace(env, objects=tuple(dict.fromkeys(str(meta["object"]) for meta in metas)))
    return env
