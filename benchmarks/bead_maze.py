"""Does touch lead a bead along a wire never seen (TacBench T5, Sparsh Table 10), closed loop too?

Every policy of the same recipe counts as one arm, its seeds as repeats. All arms meet the same
wires and the same starts. Open loop: see `policies/compounding.py`, along expert demonstrations on
test wires that nothing disturbs.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from touchgoal.control.errors import UserError
from touchgoal.episodes.recording import Actor, collect
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies import checkpoint, compounding
from touchgoal.policies.acting import SHIPPED, ActorMaker, Observation, Planner, PolicyActor
from touchgoal.policies.compounding import Compounded, Plan, compound
from touchgoal.policies.follower import WireFollower
from touchgoal.policies.maze_trials import MazeTrial, evaluate, trials_of
from touchgoal.policies.policy import Condition, Policy
from touchgoal.policies.success import SuccessRate
from touchgoal.policies.touch import load_touch
from touchgoal.policies.windows import Windows, read
from touchgoal.sim_envs.bead_maze import BeadMaze, BeadMazeConfig
from touchgoal.sim_envs.maze_expert import BeadMazeExpert
from touchgoal.sim_envs.wires import HELD_OUT, choose

FIRST_SEED = 4_000_000


@dataclass(frozen=True)
class Config:
    """Options of benchmark bead-maze."""

    out: Path | None = None
    """Folder of the run."""
    policies: tuple[Path, ...] = (SHIPPED["bead-maze"],)
    """Policies that train-policy made; those of one recipe count as seeds of one arm."""
    wires: int = 100
    """Test wires of the families trained on."""
    held_out: int = 20
    """Test wires of the family held out."""
    demonstrations: int = 20
    """Test wires on which open-loop errors are measured."""
    latencies: tuple[int, ...] = (1, 2)
    """Ticks by which plans come late, tried besides 0 on the first policy."""
    workers: int = 2
    """Processes that simulate."""


@dataclass(frozen=True)
class Follower:
    """Makes the classical follower."""

    def __call__(self, env: BeadMaze) -> Actor:
        """For one episode."""
        return WireFollower(env.config.control_hz)


class MisledPlanner(Planner):
    """A planner that feels, tick by tick, what was felt on another wire."""

    felt: Float[np.ndarray, "t e"]
    tick = -1

    def plan(self, seen: Any) -> Float[np.ndarray, "h 8"]:
        """As `Planner.plan`."""
        self.tick = min(self.tick + self.config.execution_horizon, len(self.felt) - 1)
        return super().plan(seen)

    def _feel(self, observation: Observation) -> Float[np.ndarray, " e"]:
        return self.felt[max(self.tick, 0)]


@dataclass(frozen=True)
class Misled(ActorMaker):
    """Makes a policy whose touch was shuffled: it feels other episodes, drawn by `seed`.

    Attributes:
        bank: folder of embedded episodes, as `windows.read` caches them.
    """

    bank: Path = Path()

    def __call__(self, env: BeadMaze) -> Actor:
        """For one episode."""
        torch.set_num_threads(1)
        policy = checkpoint.load(self.directory)
        planner = MisledPlanner(policy, load_touch(self.directory / checkpoint.TOUCH), self.seed)
        episodes = sorted(self.bank.glob("*.npy"))
        chosen = int(env.np_random.integers(len(episodes)))
        planner.felt = np.load(episodes[chosen]).astype(np.float32)
        return PolicyActor(planner, self.latency)


def run(config: Config) -> dict[str, Any]:
    """Open loop, then closed loop.

    Returns:
        `table`, and the numbers behind it.
    """
    if not config.policies:
        raise UserError("name at least one policy folder with --policies")
    arms = _arms(config.policies)
    recorded = _record(config)
    opened = {name: _open_loop(arm, recorded) for name, arm in arms.items()}
    closed = _closed_loop(config, arms, recorded.root.parent / "embeddings")
    table = "\n\n".join([_closed_table(closed), _open_table(opened)])
    return {
        "table": table,
        "closed_loop": {name: [t.__dict__ for t in trials] for name, trials in closed.items()},
        "open_loop": opened,
    }


def _arms(policies: tuple[Path, ...]) -> dict[str, list[Path]]:
    arms: dict[str, list[Path]] = {}
    for directory in policies:
        config = checkpoint.load(directory).config
        touch = "frozen touch" if config.touch_dim else "state only"
        episodes = checkpoint.POLICY.provenance(directory)["episodes"]
        head = "" if hasattr(config.head, "unet") else ", regression"
        arms.setdefault(f"{touch}, {episodes} demos{head}", []).append(directory)
    return arms


# ---- closed loop


def _closed_loop(
    config: Config, arms: dict[str, list[Path]], bank: Path
) -> dict[str, list[MazeTrial]]:
    maze = BeadMazeConfig(split="test")
    blind = replace(maze, tactile=False)
    jobs = trials_of(choose("test", config.wires, maze.families), FIRST_SEED)
    other = trials_of(choose("test", config.held_out, (HELD_OUT,)), FIRST_SEED + 10_000)
    results: dict[str, list[MazeTrial]] = {}

    def try_(name: str, env: BeadMazeConfig, makers: list[Callable], trials: list) -> None:
        print(f"{name}: {len(makers)} x {len(trials)} wires")
        results[name] = [t for m in makers for t in evaluate(env, m, trials, config.workers)]

    try_("expert (sees the wire)", blind, [BeadMazeExpert], jobs)
    try_("follower (force and first tangent)", blind, [Follower()], jobs)
    try_(f"follower, {HELD_OUT}", blind, [Follower()], other)
    for name, directories in arms.items():
        makers = [ActorMaker(d) for d in directories]
        env = makers[0].observing(maze)
        try_(name, env, makers, jobs)
        if env.tactile:
            try_(f"{name}, {HELD_OUT}", env, makers, other)
            misled = [Misled(d, bank=_bank(bank, d)) for d in directories]
            try_(f"{name}, shuffled", blind, misled, jobs)
    first = config.policies[0]
    for latency in config.latencies:
        late = ActorMaker(first, latency=latency)
        try_(f"first policy, {latency} ticks late", late.observing(maze), [late], jobs)
    return results


def _closed_table(results: dict[str, list[MazeTrial]]) -> str:
    lines = [
        f"{'closed loop, test wires':<44}{'success [95 % Wilson]':<24}"
        f"{'completed [95 %]':<22}{'drop':>5}{'jam':>5}{'force':>6}{'peak N':>8}"
    ]
    for name, trials in results.items():
        rate = SuccessRate(sum(t.success for t in trials), len(trials))
        failures = [
            sum(t.failure == kind for t in trials) for kind in ("drop", "jam", "over_force")
        ]
        low, high = bootstrap([(t.wire, t.progress) for t in trials])
        done = f"{np.mean([t.progress for t in trials]):.0%} [{low:.0%}, {high:.0%}]"
        lines.append(
            f"{name:<44}{rate!s:<24}{done:<22}{failures[0]:>5}{failures[1]:>5}{failures[2]:>6}"
            f"{np.median([t.peak_force for t in trials]):>8.1f}"
        )
    return "\n".join(lines)


def bootstrap(values: list[tuple[str, float]], draws: int = 5000) -> tuple[float, float]:
    """95 % interval of the mean: wires are drawn, then, within each, the training seeds."""
    rng = np.random.default_rng(0)
    groups: dict[str, list[float]] = {}
    for name, value in values:
        groups.setdefault(name, []).append(value)
    rows = np.array(list(groups.values()))  # wires x seeds: every seed met every wire
    wires = rng.integers(len(rows), size=(draws, len(rows), 1))
    seeds = rng.integers(rows.shape[1], size=(draws, 1, rows.shape[1]))
    means = rows[wires, seeds].mean((1, 2))
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


# ---- open loop


def _record(config: Config) -> EpisodeSet:
    """Undisturbed expert demonstrations on test wires; recorded once for all runs."""
    root = Path("runs") / "bead_maze_test" / "episodes"
    if root.exists() and len(EpisodeSet(root)) == config.demonstrations:
        return EpisodeSet(root)
    if root.exists():
        raise UserError(f"{root} holds another number of demonstrations: delete {root.parent}")
    wires = choose("test", config.demonstrations)
    collect(root, BeadMazeConfig(split="test"), trials_of(wires, FIRST_SEED), config.workers)
    return EpisodeSet(root)


def _bank(bank: Path, directory: Path) -> Path:
    return bank / load_touch(directory / checkpoint.TOUCH).name.replace("/", "_")


def _open_loop(directories: list[Path], episodes: EpisodeSet) -> dict[str, dict[str, Any]]:
    """Errors of an arm and of the trivial baselines, each over demonstrations and seeds."""
    rows: dict[str, list[Compounded]] = {}
    for seed, directory in enumerate(directories):
        policy = checkpoint.load(directory)
        touch = load_touch(directory / checkpoint.TOUCH) if policy.config.touch_dim else None
        bank = _bank(episodes.root.parent / "embeddings", directory) if touch else Path()
        read(episodes, range(len(episodes)), policy.config, touch, bank)  # embeds, all at once
        for i in range(len(episodes)):
            windows = Windows(read(episodes, [i], policy.config, touch, bank), policy.config)
            plans = {"policy": _sampled(policy)}
            if touch:
                other = (i + 1) % len(episodes)
                felt = read(episodes, [other], policy.config, touch, bank).touch
                plans["policy, shuffled touch"] = _misled(policy, felt)
            if seed == 0:
                mean = windows.recorded.actions.mean(0)
                plans |= {
                    "zero motion": compounding.zero_motion,
                    "repeat last": compounding.repeat_last(policy.config.control_hz),
                    "mean action": compounding.always(mean),
                }
            for name, plan in plans.items():
                errors = compound(plan, windows, policy.config.control_hz)
                rows.setdefault(name, []).append(errors)
    return {name: _summary(errors) for name, errors in rows.items()}


def _sampled(policy: Policy) -> Plan:
    generator = torch.Generator().manual_seed(0)
    return lambda condition: policy.plan(condition, generator)


def _misled(policy: Policy, felt: torch.Tensor) -> Plan:
    plan = _sampled(policy)

    def misled(condition: Condition) -> torch.Tensor:
        rows = torch.arange(len(condition.touch)) % len(felt)
        touch = felt[rows].float()[:, None].expand_as(condition.touch)
        return plan(Condition(touch, condition.state))

    return misled


def _summary(errors: list[Compounded]) -> dict[str, Any]:
    return {
        "chunk_mm": np.mean([e.chunk for e in errors], 0).tolist(),
        "forced_mm": [float(e.forced.mean()) for e in errors],
        "forced_final_mm": [float(e.forced[-1]) for e in errors],
        "free_mm": [float(e.free.mean()) for e in errors],
        "path_mm": float(np.mean([e.path for e in errors])),
    }


def _open_table(arms: dict[str, dict[str, dict[str, Any]]]) -> str:
    lines = []
    for arm, rows in arms.items():
        path = next(iter(rows.values()))["path_mm"]
        lines.append(
            f"{'open loop, mm: ' + arm:<44}{'(A) tick 1':>11}{'(A) tick 8':>11}"
            f"{'(B) mean':>10}{'(B) final':>10}{'(C) mean':>10}   way {path:.0f} mm"
        )
        lines += [
            f"{'  ' + name:<44}{r['chunk_mm'][0]:>11.2f}{r['chunk_mm'][-1]:>11.2f}"
            f"{np.mean(r['forced_mm']):>10.2f}{np.mean(r['forced_final_mm']):>10.2f}"
            f"{np.mean(r['free_mm']):>10.2f}"
            for name, r in rows.items()
        ]
    return "\n".join(lines)
