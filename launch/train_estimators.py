"""Train the senses of pick-and-place: contact in touch, the scene at the start in pictures."""

import os
import shlex
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from touchgoal.control import features as ft
from touchgoal.encoders import pretrained
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch.run_folder import open_run, write_json
from touchgoal.policies.perception.frozen_touch import load_touch
from touchgoal.policies.perception.placements import place
from touchgoal.policies.perception.pose_estimator import SightConfig
from touchgoal.policies.perception.state_estimation import SensesConfig, SensesNetwork, save_senses
from touchgoal.policies.perception.training import (
    LearnConfig,
    felt,
    judge_contact,
    judge_sight,
    learn_contact,
    learn_sight,
)
from touchgoal.sim_envs.pick_place import PickPlaceConfig

_SEED, _VALIDATION_SEED = 4_000_000, 4_900_000  # of the things placed


@dataclass(frozen=True)
class Config:
    """Options of train-estimators."""

    episodes: Path
    """Set of pick-and-place episodes with touch, to learn contact from."""
    validation: Path
    """Set of other episodes, on which contact is judged."""
    out: Path | None = None
    """Folder of the run; the senses go to its `senses/`."""
    touch: Path = pretrained.SHIPPED
    """Folder of a frozen touch encoder (train-encoder). It is not copied: the shipped one is found
    again, another one is to be put into the senses' `touch/`."""
    things: int = 600
    """Objects to look at, of random kind and size."""
    places: int = 20
    """On the table, for each of them."""
    sight: SightConfig = SightConfig()
    """The network that looks."""
    learn: LearnConfig = LearnConfig()
    """The training."""
    env: PickPlaceConfig = field(default_factory=PickPlaceConfig)
    """Options of the task."""
    workers: int = os.cpu_count() or 1
    """Processes that render and embed."""


def main(config: Config) -> None:
    """Place, embed, train, judge."""
    touch = load_touch(config.touch)
    out = open_run(config.out, "train-estimators", config)
    torch.manual_seed(config.learn.seed)
    network = SensesNetwork(SensesConfig(touch.name, touch.dim, config.sight))
    sets = EpisodeSet(config.episodes), EpisodeSet(config.validation)
    rows, validation = (felt(episodes, touch, config.workers) for episodes in sets)
    learn_contact(network, *rows, config.learn)
    errors: dict = {"contact": judge_contact(network, *validation)}
    cameras = tuple(key.removeprefix(ft.IMAGE_PREFIX) for key, _ in config.sight.windows)
    size = config.sight.size
    env = replace(config.env, tactile=False, cameras=cameras, camera_size=size)
    learn_sight(
        network.sight,
        place(env, config.things, config.places, _SEED, config.workers),
        config.learn,
    )
    others = place(env, max(1, config.things // 8), 5, _VALIDATION_SEED, config.workers)
    errors |= judge_sight(network.sight, others)
    recipe = {"command": shlex.join(["touchgoal", *sys.argv[1:]]), "errors": errors}
    save_senses(network, out / "senses", recipe)
    write_json(out / "metrics.json", errors)
    print(f"contact: {errors['contact']:.2%} of ticks misread")
    for name, (middle, most) in list(errors.items())[1:]:
        print(f"{name.replace('_', ', ')}: {middle:.1f} (median), {most:.1f} (90 %)")
    print(f"senses: {out / 'senses'}")
