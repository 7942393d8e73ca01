"""Recording of touches by the wand: the MMWand data set on the simulated bench.

A visit puts one object on the bench and touches it several times; it moves before each touch. A
round visits every object once, with one gel on the wand; the next round has another. Each touch is
an episode.
"""

from contextlib import closing
from functools import partial
from itertools import chain, islice
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from touchgoal.control import features as ft
from touchgoal.control.tactile.gel_wear import find_wear
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.control.wand_touch import CLIP
from touchgoal.episodes.format.encoding import EncodedEpisode, encode
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.episodes.wand.episode import FPS, SET, Visit, wand_episode
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.parallel.parallel_map import Workers, parallel_map
from touchgoal.runtime.parallel.shard import WHOLE, Shard
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.touch_wand import Touch, TouchWand, TouchWandConfig
from touchgoal.sim_envs.wand.objects import wand_objects

TOUCHES_A_VISIT = 9
_TRIES = 2000  # random approaches before an object counts as out of reach


def visits(count: int) -> int:
    """Return the number of visits in which `count` touches are recorded."""
    return -(-count // TOUCHES_A_VISIT)


def record_touches(
    root: Path, sensor: str, seed: int, count: int, workers: Workers, shard: Shard = WHOLE
) -> EpisodeSet:
    """Record the first `count` touches; those that the folder holds are not simulated again.

    UserError: the folder holds another set, or cannot be written to.

    Args:
        seed: random seed of the set; touch i is the same for any count.
        shard: part of the visits to record; the others go to other folders.
    """
    chosen = [visit for visit in range(visits(count)) if shard.holds(visit)]
    own = sum(min(TOUCHES_A_VISIT, count - visit * TOUCHES_A_VISIT) for visit in chosen)
    config = f"{sensor}, seed {seed}"
    with closing(EpisodeWriter(root, fps=FPS)) as writer:
        have = len(writer)
        meta = EpisodeSet(root).meta(0) if have else {}
        if have and (other := meta.get(SET)) != config:
            raise UserError(
                f"{root} holds other touches ({other}), not {config}: give another folder"
            )
        if have:
            shard.require(int(str(meta["visit"])), root)
        if have < own:
            begun, first = divmod(have, TOUCHES_A_VISIT)
            with parallel_map(partial(_visit, sensor, seed), chosen[begun:], workers) as made:
                new = islice(chain.from_iterable(made), first, first + own - have)
                for episode in track(new, "touches", "touch", own - have):
                    writer.append(episode)
                    if wear := episode.description.meta["gel_wear"]:
                        print(f"touch {len(writer) - 1}: the gel looks {wear}: take a new one")
    return EpisodeSet(root)


def _visit(sensor: str, seed: int, number: int) -> list[EncodedEpisode]:
    """Touch one object several times."""
    objects = list(wand_objects().values())
    gel, which = divmod(number, len(objects))
    item, origin = objects[which], f"{sensor}, seed {seed}"
    visit = Visit(origin, sensor, item.name, item.descriptions, gel, number)
    env = TouchWand(TouchWandConfig(sensor=sensor, object=item.name, gel=seed + gel))
    env.reset(seed=int(np.random.SeedSequence([seed, number]).generate_state(1)[0]))
    camera = np.random.default_rng([seed, number, 1])
    try:
        first = env.untouched(camera)
        return [encode(_episode(env, visit, first, camera), FPS) for _ in range(TOUCHES_A_VISIT)]
    finally:
        env.close()


def _random_touch(env: TouchWand) -> Touch:
    """Move the object, and touch it anywhere."""
    for _ in range(_TRIES):
        env.move_object()
        touch = env.touch(env.random_action())
        if touch is not None:
            return touch
    raise UserError(f"the wand cannot reach {env.object.name}")


def _episode(
    env: TouchWand, visit: Visit, first: UInt8[np.ndarray, "h w 3"], camera: np.random.Generator
) -> Episode:
    """Touch the object once, and look at the gel afterwards; `first` is its first image."""
    touch = _random_touch(env)
    wear = find_wear(env.untouched(camera), first, find_sensor(visit.sensor))
    episode = wand_episode(touch, visit, wear)
    nothing = np.zeros(CLIP, bool)
    episode.frames[ft.TRUTH_PAD_WRENCH] = np.hstack([touch.wrench, np.zeros_like(touch.wrench)])
    episode.frames[ft.TRUTH_CONTACT] = np.stack([touch.load > 0, nothing], axis=1)
    return episode
