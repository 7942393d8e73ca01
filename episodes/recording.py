"""From acting in an environment to episodes on disk, on all cores."""

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import UInt8

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.episodes.encoding import EncodedEpisode, encode
from touchgoal.episodes.schema import Episode, MetaValue
from touchgoal.episodes.store import EpisodeWriter
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.cell.environment import FrankaTactileEnv
from touchgoal.sim_envs.config import Outcome, TaskConfig
from touchgoal.sim_envs.scene.filming import SceneRecorder
from touchgoal.sim_envs.tasks import make_env, make_expert


@runtime_checkable
class Actor(Protocol):
    """Anything that acts: an expert, a policy, a person."""

    def act(self, observation: Observation) -> np.ndarray:
        """The action (8,) for the next tick."""
        ...


@dataclass(frozen=True)
class EpisodeSpec:
    """One episode to record: the same spec always gives the same episode."""

    seed: int
    outcome: Outcome = "success"
    options: dict[str, Any] = field(default_factory=dict)


CORRECTED = "corrected"  # outcome of an episode in which a learner acted and an expert answered
Roles = Callable[[Any, EpisodeSpec], tuple[Actor, Actor]]
"""Who acts in an environment after its reset, and whose answers to all that is seen are recorded:
one and the same expert, or a learner and the expert that corrects it."""


def expert_alone(env: FrankaTactileEnv, spec: EpisodeSpec) -> tuple[Actor, Actor]:
    """The task's expert, succeeding or failing as the spec asks; see Roles."""
    expert = make_expert(env, spec.outcome)
    return expert, expert


def run(
    env: FrankaTactileEnv,
    actor: Actor,
    observation: Observation,
    info: dict[str, Any],
    expert: Actor | None = None,
) -> Iterator[dict[str, np.ndarray]]:
    """Act until the episode ends; yields what was seen, done and true at each tick.

    Args:
        env: after its reset.
        actor: chooses the actions.
        observation, info: what the reset returned.
        expert: if given, what it would have done stands for what was done.
    """
    while True:
        action = np.asarray(actor.act(observation), np.float32)
        answer = np.asarray(expert.act(observation), np.float32) if expert else action
        yield {**observation, ft.ACTION: answer, **info}
        observation, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            break
    still = np.append(np.zeros(env.n_joints), answer[-1]).astype(np.float32)
    yield {**observation, ft.ACTION: still, **info}


def record_episode(
    env: FrankaTactileEnv, spec: EpisodeSpec, roles: Roles = expert_alone
) -> Episode:
    """Record an expert's answers."""
    observation, info = env.reset(seed=spec.seed, options=spec.options)
    actor, expert = roles(env, spec)
    if expert is actor:
        return to_episode(env, list(run(env, actor, observation, info)), spec)
    ticks = list(run(env, actor, observation, info, expert))
    episode = to_episode(env, ticks, spec)
    return replace(episode, meta={**episode.meta, "outcome": CORRECTED})


def record_with_film(
    env: FrankaTactileEnv,
    spec: EpisodeSpec,
    policy: Callable[[Any], Actor] | None = None,
    meshes: Literal["fast", "full"] = "full",
) -> tuple[Episode, UInt8[np.ndarray, "n h w 3"]]:
    """Record and film an episode of the expert, or of the actor that `policy` makes.

    Returns:
        The episode, and pictures for `episodes.film.write_film`.
    """
    observation, info = env.reset(seed=spec.seed, options=spec.options)
    actor = policy(env) if policy else make_expert(env, spec.outcome)
    film = SceneRecorder(env, meshes)
    ticks = []
    at_most = round(env.config.max_seconds * env.config.control_hz)
    for tick in track(run(env, actor, observation, info), "filming", "frame", total=at_most):
        ticks.append(tick)
        film.capture()
    film.close()
    return to_episode(env, ticks, spec), film.pictures


def to_episode(
    env: FrankaTactileEnv, ticks: list[dict[str, np.ndarray]], spec: EpisodeSpec
) -> Episode:
    """The episode of the ticks that were run in an environment."""
    success = bool(ticks[-1][ft.TRUTH_SUCCESS][0])
    asked_to_fail = spec.outcome != "success"
    return Episode(
        frames={key: np.stack([tick[key] for tick in ticks]) for key in ticks[0]},
        task=env.instruction(),
        meta=env.episode_info()
        | {
            "task": env.task,
            "seed": spec.seed,
            "outcome": spec.outcome if success or asked_to_fail else "failure",
            "success": success,
        },
    )


def collect(
    root: Path,
    config: TaskConfig,
    specs: Sequence[EpisodeSpec],
    workers: int,
    roles: Roles = expert_alone,
) -> list[dict[str, MetaValue]]:
    """Append episodes to the set in `root`, in the order of their specs.

    Workers simulate and encode; this process alone writes, so that an interruption loses at most
    the episodes in progress. The roles must pickle.

    Returns:
        The `meta` of each episode, outcome and success included.

    Raises:
        UserError: nothing to record, the set cannot be continued, or another process records
            into it.
    """
    if not specs:
        raise UserError("nothing to collect: ask for at least one episode")
    metas = []
    writer = EpisodeWriter(root, fps=config.control_hz)  # refuses a second recorder at once
    try:
        with one_core_workers(workers) as pool:
            encoded = pool.map(partial(_record, config, roles), specs)
            for episode in track(encoded, "recording", "episode", total=len(specs)):
                writer.append(episode)
                metas.append(episode.description.meta)
    finally:
        writer.close()
    return metas


@contextmanager
def one_core_workers(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Workers that use one core each.

    OpenGL contexts do not survive a fork, so they are forked from a server that never renders; it
    imports once, for all workers of this process, what this process has imported.

    Should anything end the block early, Ctrl-C for example, the workers end at once: what they
    have in hand is lost.
    """
    others = set(multiprocessing.active_children())
    forkserver = multiprocessing.get_context("forkserver")
    forkserver.set_forkserver_preload([m for m in sys.modules if m.startswith("touchgoal.")])
    pool = ProcessPoolExecutor(workers, mp_context=forkserver, initializer=_begin_work)
    try:
        yield pool
    except BaseException:
        for worker in set(multiprocessing.active_children()) - others:
            worker.terminate()
        pool.shutdown(cancel_futures=True)
        raise
    pool.shutdown()


def _begin_work() -> None:
    """Leave Ctrl-C to the process that started this one, and the other cores to the others.

    OpenCV and software OpenGL would start threads there.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    os.environ["LP_NUM_THREADS"] = "1"


def _record(config: TaskConfig, roles: Roles, spec: EpisodeSpec) -> EncodedEpisode:
    env = make_env(config)
    try:
        return encode(record_episode(env, spec, roles), config.control_hz)
    finally:
        env.close()
