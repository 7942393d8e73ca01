"""Grip force found by trial on rods that break unseen: the reward chooses the best third of the trials.

A rod is lost below a force and crushed above another, and neither force is known. Nobody tells the
search of a crushed rod: it arrives like a whole one. Each trial carries the rod with one force, and
the cross-entropy method moves its guess. Goals and units of the reward come from successes with other
rods, which need the least force of all: a touch as gentle as theirs, without slip, is the goal.

A trial is deterministic. So each rod is carried once with each force of a grid, its last frame is
embedded and kept in the run's folder, and a search looks its trials up there, at the nearest force.
Searches of one rod share its table: their number narrows the interval, not the choice of rods.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from benchmarks.options import CORES, BenchmarkOptions
from benchmarks.papers.fragile_carry import OneForce
from touchgoal.control.features import CAMERAS, TACTILE, TRUTH_SUCCESS, WRENCH, Observation
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.rewards.distance.fit_normalizer import fit_units
from touchgoal.rewards.distance.normalizer import EmbeddingSource
from touchgoal.rewards.distance.parts import TOUCH_PARTS, part_costs
from touchgoal.rewards.features.embedded import (
    EmbeddedEpisode,
    Features,
    join_rows,
    load_features,
    save_features,
    take_rows,
)
from touchgoal.rewards.features.embedder import EpisodeEmbedder
from touchgoal.rewards.metrics import START_FRAMES
from touchgoal.rewards.reward import Reward
from touchgoal.rewards.reward_wrapper import inputs_of
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Count, Seed, checked_dataclass
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import ForceRange, FragileCarryConfig
from touchgoal.sim_envs.experts.fragile_carry import FragileCarryExpert
from touchgoal.sim_envs.fragile_carry import FragileCarry

_GOAL_SEED = seeds.REWARD_GOALS.start + 90_000
_LEAST, _MOST = np.log([0.8, 24.0])  # forces of the table, log N
_EVERY = 3  # every n-th frame is embedded: the contact is followed as well, three times faster
_CAMERAS = ("front", "wrist", "wrist_map")
PARTS: dict[str, tuple[str, ...]] = {
    "image": ("front",),
    "both cameras": _CAMERAS,
    "touch": TOUCH_PARTS,
    "fused": (*_CAMERAS, *TOUCH_PARTS, "wrench"),
}
"""Parts of the cost by row, whose root mean square it is. The wrist camera sees how far the fingers
have closed, and so how hard they press: the rods are equally thick."""
ROWS = ("chance", "sparse", *PARTS)
"""What chooses the best third of the trials: chance, whether the rod arrived ("sparse"), or a cost."""


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark grip-search."""

    rods: Count = 30
    """Rods, each of which is searched for by itself."""
    seed: Seed = seeds.REWARD_TEST.start + 790_000
    """Random seed of the first rod; each further one adds one."""
    forces: Count = 14
    """Forces that a rod is tried with, 0.8 to 24 N; a search begins in their middle."""
    goals: Count = 8
    """Successes with other rods."""
    goal_rods: ForceRange = (1.0, 1.3)
    """Range of the force that just holds these, N; no rod of fragile-carry needs less than 1 N."""
    searches: Count = 10
    """Searches for each rod, by each row."""
    rounds: Count = 3
    """Rounds of trials."""
    samples: tuple[Count, ...] = (4, 12)
    """Trials of a round; all searches are made with each of these numbers."""
    env: FragileCarryConfig = FragileCarryConfig(cameras=("front", "wrist"))
    """Environment."""
    workers: Count = CORES
    """Processes that simulate and embed."""


@dataclass(frozen=True)
class _Carry:
    """One episode: a rod carried with one force (N), or by the expert if it is None."""

    file: Path
    seed: int
    force: float | None = None
    hold_force: float | None = None  # N that just holds the rod; None: drawn from the seed


@dataclass(frozen=True, eq=False)
class _Table:
    """What came of one rod at each force."""

    arrived: Bool[np.ndarray, " forces"]  # neither lost nor tilted, and put down on the other rests
    safe: Bool[np.ndarray, " forces"]  # arrived, and not crushed
    costs: Mapping[str, Float[np.ndarray, " forces"]]  # of the last frame, by row


def run(config: Config) -> dict[str, Any]:
    """Record what the table lacks, and search."""
    with tempfile.TemporaryDirectory() as folder:
        tables = _tables(config, (config.out or Path(folder)) / "trials")
    jobs = list(product(range(config.rods), range(config.searches)))
    text = f"{f'{config.rods} rods, safe force':<30}{'[95 % Wilson]':<22}{'lost':>6}{'crushed':>9}"
    ends: dict[str, dict[int, list[str]]] = {row: {} for row in ROWS}
    for row, samples in product(ROWS, config.samples):
        found = [
            _search(config, tables[rod], row, samples, [config.seed, rod, number])
            for rod, number in jobs
        ]
        trials, rate = samples * config.rounds, SuccessRate(found.count("safe"), len(found))
        missed = f"{found.count('lost'):>6}{found.count('crushed'):>9}"
        text += f"\n{f'{row}, {trials} trials':<30}{rate!s:<22}{missed}"
        ends[row][trials] = found
    return {"table": text, "rods": config.rods, "ends": ends}


def _search(config: Config, table: _Table, row: str, samples: int, seed: Sequence[int]) -> str:
    """Return what the last mean does to the rod: "safe", "lost" or "crushed".

    Of equal costs the force that was drawn first wins.
    """
    rng = np.random.default_rng(seed)

    def nearest(forces: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
        at = np.rint((forces - _LEAST) / (_MOST - _LEAST) * (config.forces - 1))
        return at.clip(0, config.forces - 1).astype(int)

    def costs(at: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        if row == "chance":
            return rng.random(len(at))
        return 1.0 - table.arrived[at] if row == "sparse" else table.costs[row][at]

    mean, spread = (_LEAST + _MOST) / 2, (_MOST - _LEAST) / np.sqrt(12)
    for _ in range(config.rounds):
        forces = rng.normal(mean, spread, samples)
        best = forces[np.argsort(costs(nearest(forces)), kind="stable")[: max(samples // 3, 2)]]
        mean, spread = best.mean(), best.std()
    [at] = nearest(np.array([mean]))
    return "safe" if table.safe[at] else "crushed" if table.arrived[at] else "lost"


def _tables(config: Config, folder: Path) -> list[_Table]:
    """Return a table for each rod; the costs are to the ends of the successes with other rods."""
    folder.mkdir(parents=True, exist_ok=True)
    held = np.geomspace(*config.goal_rods, config.goals)
    goals = [
        _Carry(folder / f"goal-{k}-{n:.3f}.npz", _GOAL_SEED + k, None, float(n))
        for k, n in enumerate(held)
    ]
    rods = range(config.seed, config.seed + config.rods)
    trials = [
        _Carry(folder / f"rod-{rod}-{force:.3f}.npz", rod, float(force))
        for rod, force in product(rods, np.exp(np.linspace(_LEAST, _MOST, config.forces)))
    ]
    missing = [carry for carry in (*goals, *trials) if not carry.file.is_file()]
    with parallel_map(partial(_record, config.env), missing, config.workers) as results:
        list(track(results, "carrying", "rod", total=len(missing)))
    ends = [row for row, about in (load_features(g.file) for g in goals) if about["safe"]]
    if len(ends) < 2:
        raise UserError("fewer than two goals are successes: give more --goals")
    source = EmbeddingSource("", "")  # one embedder has made all of them
    units, goal = fit_units([EmbeddedEpisode(e, source, "", 1) for e in ends]), join_rows(ends)
    tables = []
    for i in range(0, len(trials), config.forces):
        read = [load_features(carry.file) for carry in trials[i : i + config.forces]]
        parts = part_costs(join_rows([features for features, _ in read]), goal, units)
        squares = {row: [parts[name] ** 2 for name in names] for row, names in PARTS.items()}
        costs = {row: np.sqrt(np.mean(square, axis=0)) for row, square in squares.items()}
        arrived, safe = (np.array([about[key] for _, about in read]) for key in ("arrived", "safe"))
        tables.append(_Table(arrived, safe, costs))
    return tables


@cache
def _simulator(config: FragileCarryConfig) -> tuple[FragileCarry, EpisodeEmbedder]:
    env = FragileCarry(config)
    return env, Reward().embedder(inputs_of(env))


def _record(config: FragileCarryConfig, carry: _Carry) -> None:
    """Carry a rod; write its embedded last frame, and whether it arrived and is whole."""
    env, embedder = _simulator(config)
    options = {} if carry.hold_force is None else {"hold_force": carry.hold_force}
    observation, info = env.reset(seed=carry.seed, options=options)
    crush, env.crush_force = env.crush_force, np.inf  # a crushed rod is carried on
    expert = FragileCarryExpert(env)
    actor = expert if carry.force is None else OneForce(expert, carry.force)
    seen, pressed, ended = [observation], [0.0], False
    while not ended:
        observation, _, done, late, info = env.step(actor.act(observation))
        seen.append(observation)
        pressed.append(max(pad.normal_force for pad in env.pad_contacts()))
        ended = done or late
    # Two ticks above its crush force in a row break the rod, as in the task.
    whole = np.minimum(pressed[1:], pressed[:-1]).max() <= crush
    arrived = bool(info[TRUTH_SUCCESS][0])
    about = {"arrived": arrived, "safe": bool(arrived and whole), "hold_force": env.hold_force}
    save_features(carry.file, _embed_end(embedder, seen, config.control_hz), about)


def _embed_end(embedder: EpisodeEmbedder, seen: Sequence[Observation], hz: int) -> Features:
    """Return the features of the last frame; the fingertips are followed through the episode."""
    chosen = [*seen[:START_FRAMES], *seen[START_FRAMES:-1:_EVERY], seen[-1]]
    frames = {key: np.stack([o[key] for o in chosen]) for key in (*CAMERAS, *TACTILE, WRENCH)}
    stream, last = embedder.stream(frames, hz / _EVERY, "a trial"), slice(-1, None)
    touched = stream.embed({key: frames[key] for key in (*TACTILE, WRENCH)}).features
    images = embedder.embed_cameras({key: frames[key][last] for key in CAMERAS})
    return {**take_rows(touched, last), **images}
