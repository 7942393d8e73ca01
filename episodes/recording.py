"""Acting in an environment and recording it as episodes on disk, on all cores."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from jaxtyping import UInt8

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor
from touchgoal.episodes.format import set_files
from touchgoal.episodes.format.encoding import Description, EncodedEpisode, encode
from touchgoal.episodes.outcomes.verify import outcome_reached
from touchgoal.episodes.schema import CORRECTED, Episode, MetaValue
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.parallel.parallel_map import Workers, parallel_map
from touchgoal.runtime.parallel.shard import WHOLE, Shard
from touchgoal.runtime.progress import progress_bar, track
from touchgoal.sim_envs.cell.environment import FrankaTactileEnv
from touchgoal.sim_envs.config import Outcome, TaskConfig
from touchgoal.sim_envs.scene.filming import SceneRecorder
from touchgoal.sim_envs.scene.objects import CATALOGUE, of_same_shape
from touchgoal.sim_envs.tasks import make_env, make_expert

OUTCOME_SECONDS = 1.0  # s of rest after an actor is done, in which the simulator sees the outcome


@dataclass(frozen=True)
class EpisodeSpec:
    """One episode to record; the same spec always gives the same episode."""

    seed: int
    outcome: Outcome = "success"
    options: dict[str, Any] = field(default_factory=dict)


Roles = Callable[[Any, EpisodeSpec], tuple[Actor, Actor]]
"""Return the actor, and the expert whose actions are recorded, for an environment after its reset; one
object twice if the expert itself acts."""


class NoSuccessError(UserError):
    """The first episodes of a recording all failed."""


def expert_alone(env: FrankaTactileEnv, spec: EpisodeSpec) -> tuple[Actor, Actor]:
    """Return the task's expert, which succeeds or fails as the spec asks, in both roles."""
    expert = make_expert(env, spec.outcome)
    return expert, expert


def episode_specs(
    env: TaskConfig,
    outcomes: Sequence[Outcome],
    episodes: int,
    first_seed: int,
    shard: Shard = WHOLE,
) -> list[EpisodeSpec]:
    """Return specs that take the objects (or wires) in turn, each with every outcome once.

    There are `episodes` of each outcome; seeds count up from the first one. A shard has its part of
    them: all outcomes of every object that it takes.
    """
    options, n = env.reset_options(), len(outcomes)
    return [
        episode_spec(first_seed + i, outcomes[i % n], options[i // n % len(options)])
        for i in range(n * episodes)
        if shard.holds(i // n)
    ]


def episode_spec(
    seed: int, outcome: Outcome, options: dict[str, Any], among: Sequence[str] = tuple(CATALOGUE)
) -> EpisodeSpec:
    """Return a spec; for outcome same_shape the object on the table is another one of `among`."""
    if outcome != "same_shape":
        return EpisodeSpec(seed, outcome, options)
    asked = options["object"]
    return EpisodeSpec(
        seed, outcome, options | {"object": of_same_shape(asked, among), "asked": asked}
    )


def missing_specs(
    root: Path, specs: Sequence[EpisodeSpec], corrected: bool = False
) -> list[EpisodeSpec]:
    """Return the specs whose seeds a set does not hold; all of them where nothing is recorded yet.

    An episode that is `corrected`, recorded while a policy acts, does not replace the expert's with
    the same seed.
    """
    if not (root / set_files.INFO).exists():
        return list(specs)
    metas = [episodes.meta(i) for episodes in [EpisodeSet(root)] for i in range(len(episodes))]
    alike = [meta for meta in metas if (meta.get("outcome") == CORRECTED) == corrected]
    recorded = {seed for meta in alike if isinstance(seed := meta.get("seed"), int)}
    return [spec for spec in specs if spec.seed not in recorded]


def run(
    env: FrankaTactileEnv,
    actor: Actor,
    observation: Observation,
    info: dict[str, Any],
    expert: Actor | None = None,
    outcome_seconds: float = OUTCOME_SECONDS,
) -> Iterator[dict[str, np.ndarray]]:
    """Act until the episode ends, then rest as the config says; yield each tick with action and truth.

    The environment was just reset. An expert's actions, if given, are recorded in place of the
    actor's. The actor, or the expert, ends the episode when it is done; `outcome_seconds` of rest then show
    the outcome.
    """
    rest = env.config.rest
    while True:
        action = np.asarray(actor.act(observation), np.float32)
        recorded = np.asarray(expert.act(observation), np.float32) if expert else action
        yield {**observation, ft.ACTION: recorded, **info}
        observation, _, terminated, truncated, info = env.step(action)
        if terminated or truncated or actor.given_up:
            break
        if (expert or actor).done:
            rest = max(rest, outcome_seconds)
            break
    still = np.append(np.zeros(env.n_joints), recorded[-1]).astype(np.float32)
    yield {**observation, ft.ACTION: still, **info}
    for _ in range(round(rest * env.config.control_hz)):
        observation, _, _, _, info = env.step(still)
        yield {**observation, ft.ACTION: still, **info}


def record_episode(
    env: FrankaTactileEnv, spec: EpisodeSpec, roles: Roles = expert_alone
) -> Episode:
    """Record one episode with the expert's actions."""
    observation, info = env.reset(seed=spec.seed, options=spec.options)
    actor, expert = roles(env, spec)
    teacher = None if expert is actor else expert
    ticks = list(run(env, actor, observation, info, teacher, outcome_seconds=0.0))
    episode = to_episode(env, ticks, spec)
    return replace(episode, meta={**episode.meta, "outcome": CORRECTED}) if teacher else episode


def record_with_film(
    env: FrankaTactileEnv,
    spec: EpisodeSpec,
    policy: Callable[[Any], Actor] | None = None,
    meshes: Literal["fast", "full"] = "full",
) -> tuple[Episode, UInt8[np.ndarray, "n h w 3"]]:
    """Record and film an episode, tick by tick; the images are for `episodes.film.write_film`.

    `policy` makes the actor for the environment after its reset; without it the expert acts.
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
    return to_episode(env, ticks, spec), film.images


def to_episode(
    env: FrankaTactileEnv, ticks: list[dict[str, np.ndarray]], spec: EpisodeSpec
) -> Episode:
    """Return the ticks that `run` yielded as an episode."""
    frames = {key: np.stack([tick[key] for tick in ticks]) for key in ticks[0]}
    success = bool(frames[ft.TRUTH_SUCCESS][-1, 0])
    return Episode(
        frames=frames,
        task=env.instruction(),
        meta=env.episode_info()
        | {
            "task": env.task,
            "seed": spec.seed,
            "outcome": _outcome(spec.outcome, frames, success),
            "success": success,
            "failures": env.failures(),
        },
    )


def _outcome(asked: Outcome, frames: dict[str, np.ndarray], success: bool) -> str:
    """Return the requested outcome, or "failure" or `not_` and its name if it did not come about."""
    if asked == "success":
        return "success" if success else "failure"
    return asked if outcome_reached(asked, frames) else f"not_{asked}"


def collect(
    root: Path,
    config: TaskConfig,
    specs: Sequence[EpisodeSpec],
    workers: Workers,
    roles: Roles = expert_alone,
    max_failures: int | None = None,
) -> list[dict[str, MetaValue]]:
    """Append episodes to the set in `root`, in the order of their specs.

    Workers simulate and encode; this process alone writes, so that an interruption loses at most
    the episodes in progress. The progress bar counts successes and names the commonest failure.
    Returns the `meta` of each episode, outcome and success included. UserError: nothing to record,
    the set cannot be continued, or another process records into it. NoSuccessError: the first
    `max_failures` episodes failed; they are recorded. `roles` must pickle.
    """
    if not specs:
        raise UserError("nothing to collect: ask for at least one episode")
    metas, failures = [], Counter[str]()
    # the writer refuses a second recorder at once
    with closing(EpisodeWriter(root, fps=config.control_hz)) as writer:
        _check_fits(writer, root, config)
        with (
            parallel_map(partial(record_encoded, config, roles), specs, workers) as recorded,
            progress_bar("recording", len(specs), "episode") as bar,
        ):
            for episode in recorded:
                writer.append(episode)
                metas.append(episode.description.meta)
                if reason := _failure(episode.description):
                    failures[reason] += 1
                bar.set_postfix_str(_count(len(metas), failures), refresh=False)
                bar.update()
                if len(metas) == failures.total() == max_failures:
                    raise NoSuccessError(f"stopped: {_count(len(metas), failures)}")
    return metas


def _check_fits(writer: EpisodeWriter, root: Path, config: TaskConfig) -> None:
    """Raise UserError if a task's episodes would not fit the set that the writer continues."""
    if writer.metadata:
        env = make_env(config)
        assert isinstance(env.observation_space, gym.spaces.Dict)
        spaces = {**env.observation_space.spaces, ft.ACTION: env.action_space}
        shapes = {key: space.shape or () for key, space in spaces.items()}
        writer.metadata.check_fits(root, shapes, env.task)
        env.close()


def _failure(description: Description) -> str:
    """Return why an episode that should succeed failed; "" if it did not fail."""
    meta, stats = description.meta, description.stats
    if meta["success"] or meta["outcome"] not in ("failure", CORRECTED):
        return ""
    if (failures := meta["failures"]) and isinstance(failures, list):
        return failures[0].replace("_", " ")
    if ft.TRUTH_CONTACT in stats and not any(stats[ft.TRUTH_CONTACT]["max"]):
        return "time is up before any contact"
    return "time is up"


def _count(episodes: int, failures: Counter[str]) -> str:
    text = f"{episodes - failures.total()} of {episodes} succeeded"
    for reason, count in failures.most_common(1):
        text += f", most often failed: {reason} ({count})"
    return text


def record_encoded(config: TaskConfig, roles: Roles, spec: EpisodeSpec) -> EncodedEpisode:
    """Record one episode in an environment of its own."""
    env = make_env(config)
    try:
        return encode(record_episode(env, spec, roles), config.control_hz)
    finally:
        env.close()
