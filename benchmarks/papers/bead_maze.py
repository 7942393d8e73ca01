"""Bead maze: success on unseen wires, and errors along recorded ones (TacBench T5, Sparsh Table 10).

Policies of one recipe count as one group, its training seeds as repeats. All groups get the same
wires and starts. The open-loop part is in `open_loop.py`.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, get_args

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field

from benchmarks.bootstrap import percentile_interval
from benchmarks.options import CORES, BenchmarkOptions
from benchmarks.papers import open_loop
from benchmarks.papers.open_loop import OpenLoopErrors, Plan, open_loop_errors
from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor
from touchgoal.encoders.backbones.sparsh import Method
from touchgoal.encoders.pretrained import ENCODER_FORMAT
from touchgoal.episodes.recording import EpisodeSpec, collect
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies import checkpoint
from touchgoal.policies.acting import LearnedPolicy
from touchgoal.policies.by_name import follower
from touchgoal.policies.checkpoint import SHIPPED_POLICIES, SavedPolicy
from touchgoal.policies.config import SamplerConfig
from touchgoal.policies.evaluation.evaluate import REFUSED, Trial, run_trials
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.policies.heads.mlp import MLPConfig
from touchgoal.policies.network import ObservationBatch, PolicyConfig, PolicyNetwork
from touchgoal.policies.perception.frozen_touch import shipped_touch
from touchgoal.policies.training.embedding_cache import cached_embeddings
from touchgoal.policies.training.sequence_dataset import SequenceDataset, load_recordings
from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import Count, CountOrNone, checked_dataclass
from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.config import BeadMazeConfig
from touchgoal.sim_envs.experts.bead_maze import BeadMazeExpert
from touchgoal.sim_envs.scene.wires import HELD_OUT, Wire, choose

_DRAWS = 5000  # of the bootstrap


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark bead-maze."""

    policies: tuple[Path, ...] = ()
    """Folders of policies from train-policy; default: the shipped policy."""
    wires: Count = 100
    """Test wires of the trained families."""
    held_out: CountOrNone = 20
    """Test wires of the held-out family; 0 leaves them out."""
    demonstrations: Annotated[int, Field(ge=2)] = 20
    """Test wires on which open-loop errors are measured."""
    plan_ticks: tuple[CountOrNone, ...] = (1, 2)
    """Delays of plans, in control ticks, tried besides 0 on the first policy."""
    shuffled: bool = True
    """Also try every policy on frozen touch with the touch of another wire."""
    env: BeadMazeConfig = BeadMazeConfig(split="test")
    """Options of the maze; demonstrations are recorded with the same."""
    workers: Count = CORES
    """Processes that simulate."""


class ShuffledTouchPolicy(LearnedPolicy):
    """A policy whose touch embeddings are, tick by tick, those of an episode on another wire."""

    recorded_touch: Float[np.ndarray, "t e"]
    tick = -1

    def plan(self, history: Any) -> Float[np.ndarray, "h 8"]:
        """See LearnedPolicy."""
        self.tick = min(self.tick + self.config.execution_horizon, len(self.recorded_touch) - 1)
        return super().plan(history)

    def _embed_touch(self, history: Sequence[Observation]) -> Float[np.ndarray, " e"]:
        return self.recorded_touch[max(self.tick, 0)]


@dataclass(frozen=True)
class ShuffledTouch:
    """Makes a policy whose touch comes from an episode on another wire, drawn by the trial's seed."""

    policy: SavedPolicy
    episodes: EpisodeSet  # embedded, see `load_recordings`

    def __call__(self, env: BeadMaze) -> Actor:
        """Make the policy for one episode."""
        touch = self.policy().touch
        assert touch is not None
        ticks = self.policy.plan_ticks
        policy = ShuffledTouchPolicy(self.policy.network(), touch, plan_ticks=ticks)
        wires = [self.episodes.meta(i)["wire"] for i in range(len(self.episodes))]
        rows = [i for i, wire in enumerate(wires) if wire != env.wire.name]
        chosen = rows[int(env.np_random.integers(len(rows)))]
        policy.recorded_touch = cached_embeddings(self.episodes, chosen, touch).astype(np.float32)
        return policy


def _specs(wires: list[Wire], seed: int) -> list[EpisodeSpec]:
    """Return one trial on each wire; seeds place the maze and the grip."""
    return [EpisodeSpec(seed + i, options={"wire": w.name}) for i, w in enumerate(wires)]


def run(config: Config) -> dict[str, Any]:
    """Measure open loop, then closed loop."""
    config = replace(config, policies=config.policies or (SHIPPED_POLICIES["bead-maze"],))
    arms = _group_by_recipe(config.policies)
    maze = config.env
    wires = choose(maze.split, config.demonstrations, maze.families)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "episodes"
        collect(root, maze, _specs(wires, seeds.POLICY_TEST.start), config.workers)
        recorded = EpisodeSet(root)
        opened = {name: _open_loop(arm, recorded, config.workers) for name, arm in arms.items()}
        closed = _closed_loop(config, arms, recorded)
    table = "\n\n".join([_closed_table(closed), _open_table(opened)])
    return {
        "table": table,
        "closed_loop": {name: [asdict(t) for t in trials] for name, trials in closed.items()},
        "open_loop": opened,
    }


def _group_by_recipe(policies: tuple[Path, ...]) -> dict[str, list[Path]]:
    arms: dict[str, list[Path]] = {}
    for directory in policies:
        config = checkpoint.load(directory).config
        inputs = [f"frozen touch ({_encoder_name(directory, config)})"] if config.touch_dim else []
        inputs += ["end-to-end touch"] * (config.end_to_end is not None)
        episodes = checkpoint.POLICY_FORMAT.provenance(directory)["episodes"]
        name = f"{' and '.join(inputs) or 'state only'}, {episodes} demos"
        if isinstance(config.head, MLPConfig):
            name += ", regression"
        else:
            sampler = config.head.sampler
            name += ", flow" * (sampler.kind == "flow")
            if (steps := sampler.num_inference_steps) != SamplerConfig().num_inference_steps:
                name += f", denoised in {steps} step{'s' * (steps > 1)}"
        arms.setdefault(name, []).append(directory)
    return arms


def _encoder_name(policy: Path, config: PolicyConfig) -> str:
    """Return the encoder's name if it ships, else its training method."""
    if shipped := shipped_touch(config.touch):
        return shipped
    known = ENCODER_FORMAT.provenance(policy / checkpoint.TOUCH)
    return next((n for n in ("align", *get_args(Method), "untrained") if n in known), "another")


def _closed_loop(
    config: Config, arms: dict[str, list[Path]], recorded: EpisodeSet
) -> dict[str, list[Trial]]:
    maze = config.env
    blind = replace(maze, tactile=False)
    first_seed = seeds.POLICY_TEST.start
    jobs = _specs(choose(maze.split, config.wires, maze.families), first_seed)
    other = _specs(choose(maze.split, config.held_out, (HELD_OUT,)), first_seed + 10_000)
    results: dict[str, list[Trial]] = {}

    def run_arm(name: str, env: BeadMazeConfig, makers: list[Callable], trials: list) -> None:
        if not trials:
            return
        print(f"{name}: {len(makers)} x {len(trials)} wires")
        results[name] = [t for m in makers for t in run_trials(env, m, trials, config.workers)]

    run_arm("expert (sees the wire)", blind, [BeadMazeExpert], jobs)
    run_arm("follower (force and first tangent)", blind, [follower], jobs)
    run_arm(f"follower, {HELD_OUT}", blind, [follower], other)
    for name, directories in arms.items():
        makers = [SavedPolicy(d) for d in directories]
        env = makers[0]().env_config(maze)
        run_arm(name, env, makers, jobs)
        run_arm(f"{name}, {HELD_OUT}", env, makers, other)
        if config.shuffled and checkpoint.load(directories[0]).config.touch_dim:
            shuffled = [ShuffledTouch(maker, recorded) for maker in makers]
            run_arm(f"{name}, shuffled", blind, shuffled, jobs)
    first = config.policies[0]
    for ticks in config.plan_ticks:
        late = SavedPolicy(first, plan_ticks=ticks)
        run_arm(f"first policy, {ticks} ticks late", late().env_config(maze), [late], jobs)
    return results


def _closed_table(results: dict[str, list[Trial]]) -> str:
    width = max(len(name) for name in results) + 2
    lines = [
        f"{'closed loop, test wires':<{width}}{'success [95 % Wilson]':<24}"
        f"{'completed [95 %]':<22}{'drop':>5}{'jam':>5}{'force':>6}{'refused':>9}{'peak N':>8}"
    ]
    for name, trials in results.items():
        rate = SuccessRate(sum(t.success for t in trials), len(trials))
        drops, jams, forced, refused = (
            sum(t.failure == kind for t in trials)
            for kind in ("drop", "jam", "over_force", REFUSED)
        )
        low, high = bootstrap([(str(t.episode["wire"]), t.progress) for t in trials])
        done = f"{np.mean([t.progress for t in trials]):.0%} [{low:.0%}, {high:.0%}]"
        lines.append(
            f"{name:<{width}}{rate!s:<24}{done:<22}{drops:>5}{jams:>5}{forced:>6}{refused:>9}"
            f"{np.median([t.peak_force for t in trials]):>8.1f}"
        )
    return "\n".join(lines)


def bootstrap(values: list[tuple[str, float]]) -> tuple[float, float]:
    """Return the 95 % interval of the mean: wires are drawn, then training seeds within each."""
    rng = np.random.default_rng(0)
    groups: dict[str, list[float]] = {}
    for name, value in values:
        groups.setdefault(name, []).append(value)
    rows = np.array(list(groups.values()))  # wires x seeds: every seed ran on every wire
    wires = rng.integers(len(rows), size=(_DRAWS, len(rows), 1))
    seeds = rng.integers(rows.shape[1], size=(_DRAWS, 1, rows.shape[1]))
    return percentile_interval(rows[wires, seeds].mean((1, 2)))


def _open_loop(
    directories: list[Path], episodes: EpisodeSet, workers: int
) -> dict[str, dict[str, Any]]:
    """Return errors of an arm and of trivial baselines over demonstrations and seeds."""
    rows: dict[str, list[tuple[str, OpenLoopErrors]]] = {}
    count = len(episodes)
    for seed, directory in enumerate(directories):
        policy = checkpoint.load(directory)
        config, horizon = policy.config, policy.config.prediction_horizon
        touch = SavedPolicy(directory)().touch
        if touch:
            load_recordings(episodes, range(count), config, touch, workers)  # embeds, all at once
        recorded = [load_recordings(episodes, [i], config, touch) for i in range(count)]
        for i in range(count):
            plans = {"policy": _sampled(policy)}
            if touch:
                other = recorded[(i + 1) % count].touch
                plans["policy, shuffled touch"] = _with_shuffled_touch(policy, other)
            if seed == 0:
                others = [r.actions.mean(0) for k, r in enumerate(recorded) if k != i]
                plans |= {
                    "zero motion": open_loop.zero_motion(horizon),
                    "repeat last": open_loop.repeat_last(config.control_hz, horizon),
                    "mean action": open_loop.constant_action(torch.stack(others).mean(0), horizon),
                }
            windows = SequenceDataset(recorded[i], config)
            for name, plan in plans.items():
                errors = open_loop_errors(plan, windows, config.control_hz)
                rows.setdefault(name, []).append((str(i), errors))
    return {name: _summary(errors) for name, errors in rows.items()}


def _sampled(policy: PolicyNetwork) -> Plan:
    generator = torch.Generator().manual_seed(0)
    return lambda batch: policy.plan(batch, generator).actions


def _with_shuffled_touch(policy: PolicyNetwork, recorded_touch: torch.Tensor) -> Plan:
    plan = _sampled(policy)

    def shuffled(batch: ObservationBatch) -> torch.Tensor:
        rows = torch.arange(len(batch.touch)) % len(recorded_touch)
        touch = recorded_touch[rows].float()[:, None].expand_as(batch.touch)
        return plan(replace(batch, touch=touch))

    return shuffled


def _summary(rows: list[tuple[str, OpenLoopErrors]]) -> dict[str, Any]:
    errors = [e for _, e in rows]
    forced = [(name, float(e.teacher_forced.mean())) for name, e in rows]
    return {
        "chunk_mm": np.mean([e.chunk for e in errors], 0).tolist(),
        "forced_mm": [error for _, error in forced],
        "forced_interval_mm": bootstrap(forced),
        "forced_final_mm": [float(e.teacher_forced[-1]) for e in errors],
        "free_mm": [float(e.free_running.mean()) for e in errors],
        "path_mm": float(np.mean([e.path for e in errors])),
    }


def _open_table(arms: dict[str, dict[str, dict[str, Any]]]) -> str:
    width = max(len(f"open loop, mm: {arm}") for arm in arms) + 2
    lines = []
    for arm, rows in arms.items():
        path = next(iter(rows.values()))["path_mm"]
        lines.append(
            f"{'open loop, mm: ' + arm:<{width}}{'(A) tick 1':>11}{'(A) tick 8':>11}"
            f"{'(B) mean [95 %]':>24}{'(B) final':>10}{'(C) mean':>10}   way {path:.0f} mm"
        )
        for name, r in rows.items():
            low, high = r["forced_interval_mm"]
            forced = f"{np.mean(r['forced_mm']):.2f} [{low:.1f}, {high:.1f}]"
            lines.append(
                f"{'  ' + name:<{width}}{r['chunk_mm'][0]:>11.2f}{r['chunk_mm'][-1]:>11.2f}"
                f"{forced:>24}{np.mean(r['forced_final_mm']):>10.2f}{np.mean(r['free_mm']):>10.2f}"
            )
    return "\n".join(lines)
