"""Recording of touches by the wand: the MMWand data set on the simulated bench.

A visit puts one object on the bench and touches it several times, each time moved. A round visits
every object once, with one gel on the wand; the next round has another. Each touch is an episode of
six frames: the tactile clip at the sensor's rate, beside views that change once, at contact.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from touchgoal.control import features as ft
from touchgoal.episodes.format.encoding import EncodedEpisode, encode
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track
from touchgoal.runtime.worker_pool import one_core_workers
from touchgoal.sim_envs.touch_wand import CLIP, Touch, TouchWand, TouchWandConfig
from touchgoal.sim_envs.wand.objects import WandObject, wand_objects

FPS = 25
"""Pictures a second of a GelSight Mini."""
TOUCHES_A_VISIT = 9
_BEFORE = 2  # frames of a clip that show the views before contact
_TRIES = 2000  # random approaches before an object counts as out of reach
_SET = "wand"  # meta: sensor and seed of the set


def record_touches(root: Path, sensor: str, seed: int, count: int, workers: int) -> EpisodeSet:
    """Record the first `count` touches; those that the folder holds are not simulated again.

    Args:
        root: folder of the set.
        sensor: on the wand.
        seed: random seed of the set; touch i is the same for any count.
        count: number of touches.
        workers: number of processes.

    Raises:
        UserError: the folder holds another set, or cannot be written to.
    """
    config = f"{sensor}, seed {seed}"
    writer = EpisodeWriter(root, fps=FPS)
    try:
        have = len(writer)
        if have and (other := EpisodeSet(root).meta(0).get(_SET)) != config:
            raise UserError(
                f"{root} holds other touches ({other}), not {config}: give another folder"
            )
        if have < count:
            visits = range(have // TOUCHES_A_VISIT, -(-count // TOUCHES_A_VISIT))
            with one_core_workers(workers) as pool:
                made = pool.map(partial(_visit, sensor, seed), visits)
                bar = track(_touches(made, visits, have, count), "touches", "touch", count - have)
                for episode in bar:
                    writer.append(episode)
    finally:
        writer.close()
    return EpisodeSet(root)


def _touches(
    made: Iterator[list[EncodedEpisode]], visits: range, have: int, count: int
) -> Iterator[EncodedEpisode]:
    """Yield the touches from `have` to `count` of these visits."""
    for visit, episodes in zip(visits, made, strict=True):
        for i, episode in enumerate(episodes, visit * TOUCHES_A_VISIT):
            if have <= i < count:
                yield episode


def _visit(sensor: str, seed: int, visit: int) -> list[EncodedEpisode]:
    """Touch one object several times."""
    objects = list(wand_objects().values())
    gel, which = divmod(visit, len(objects))
    item = objects[which]
    env = TouchWand(TouchWandConfig(sensor=sensor, object=item.name, gel=seed + gel))
    env.reset(seed=int(np.random.SeedSequence([seed, visit]).generate_state(1)[0]))
    try:
        return [
            encode(_episode(_random_touch(env), item, sensor, seed, gel, visit), FPS)
            for _ in range(TOUCHES_A_VISIT)
        ]
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
    touch: Touch, item: WandObject, sensor: str, seed: int, gel: int, visit: int
) -> Episode:
    contact = touch.load > 0
    frames = {
        key: np.stack([touch.before[name]] * _BEFORE + [touch.views[name]] * (CLIP - _BEFORE))
        for key in ft.WAND_VIEWS
        if (name := key.removeprefix(ft.IMAGE_PREFIX)) in touch.views
    }
    frames |= {
        ft.TACTILE_LEFT: touch.clip,
        ft.LOAD: touch.load[:, None],
        ft.TRUTH_PAD_WRENCH: np.hstack([touch.wrench, np.zeros((CLIP, 6), np.float32)]),
        ft.TRUTH_CONTACT: np.stack([contact, np.zeros(CLIP, bool)], axis=1),
    }
    meta = {
        _SET: f"{sensor}, seed {seed}",
        "sensor": sensor,
        "object": item.name,
        "descriptions": list(item.descriptions),
        "gel": gel,
        "visit": visit,
        "force": float(touch.load[-1]),
        "untouched_frames": 1,
    }
    return Episode(frames, f"touch the {item.name.replace('_', ' ')} with the wand", meta)
