"""Speed of the simulated cell on one core: physics, and whole environment steps."""

import os
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from benchmarks.options import BenchmarkOptions
from benchmarks.speed.rates import Row, measure, one_core, table
from touchgoal.runtime.option_types import Count, checked_dataclass
from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.config import BeadMazeConfig, PickPlaceConfig
from touchgoal.sim_envs.experts.pick_place import PickPlaceExpert
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.scene.build import MODELS


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark env-speed."""

    repeats: Count = 7
    """Measurements of each figure; the median is printed."""
    physics_steps: Count = 5000
    """Physics steps in a measurement."""
    env_steps: Count = 40
    """Control ticks in a measurement."""


NO_MOTION = np.zeros(8)
TICKS_UNTIL_HELD = 70  # ticks after which the expert holds the object in the air


def run(config: Config) -> dict[str, Any]:
    """Measure everything on one core, in wall-clock time."""
    os.environ["LP_NUM_THREADS"] = "0"  # software OpenGL draws in this thread
    with one_core():
        rows = [*_physics(config), *_env(config), *_maze(config)]
    printed = table("on one core, wall clock", "per second", rows)
    return {"rows": [vars(row) for row in rows], "table": printed}


def _physics(config: Config) -> list[Row]:
    n = config.physics_steps
    peer = mujoco.MjModel.from_xml_path(str(MODELS["fr3"]))
    peer.opt.timestep = 1e-3
    peer_data = mujoco.MjData(peer)
    mujoco.mj_resetDataKeyframe(peer, peer_data, 0)
    rows = [_rate("peer: bare FR3, its maker's settings", config, n, peer, peer_data)]
    env = PickPlace(PickPlaceConfig(cameras=(), tactile=False))
    for name, ticks in (("object on the table", 0), ("object held in the air", TICKS_UNTIL_HELD)):
        _reset_and_run_expert(env, ticks)
        rows.append(_rate(f"physics, whole cell, {name}", config, n, env.model, env.data))
    env.close()
    return rows


def _env(config: Config) -> list[Row]:
    rows = []
    both = ["soda_can", "pebble"]  # a primitive and a mesh
    for what, task, objects in (
        ("physics alone", PickPlaceConfig(cameras=(), tactile=False), ["soda_can"]),
        ("two tactile images", PickPlaceConfig(cameras=()), both),
        ("two tactile + one 128x128 camera", PickPlaceConfig(cameras=("front",)), both),
        (
            "two tactile + camera, full meshes",
            PickPlaceConfig(cameras=("front",), meshes="full"),
            both,
        ),
    ):
        env = PickPlace(replace(task, max_seconds=1e6))
        for name in objects:
            _reset_and_run_expert(env, TICKS_UNTIL_HELD, name)
            rows.append(_step_rate(f"{what}, holding {name}", config, env))
        env.close()
    return rows


def _maze(config: Config) -> list[Row]:
    rows = []
    for what, tactile in (("physics alone", False), ("two tactile images", True)):
        env = BeadMaze(BeadMazeConfig(tactile=tactile, max_seconds=1e6))
        env.reset(seed=1, options={"wire": "fourier-3"})
        if not tactile:
            n, where = config.physics_steps, "bead on the wire"
            rows.append(_rate(f"physics, whole cell, {where}", config, n, env.model, env.data))
        rows.append(_step_rate(f"{what}, bead on the wire", config, env))
        env.close()
    return rows


def _step_rate(what: str, config: Config, env: PickPlace | BeadMaze) -> Row:
    def steps() -> None:
        for _ in range(config.env_steps):
            env.step(NO_MOTION)

    name = f"env step (50 physics steps), {what}"
    return measure(name, config.repeats, config.env_steps, steps)


def _reset_and_run_expert(env: PickPlace, ticks: int, name: str = "soda_can") -> None:
    env.reset(seed=1, options={"object": name, "mass": 0.1, "grasp_force": 15.0})
    expert = PickPlaceExpert(env)
    for _ in range(ticks):
        env.step(expert.act({}))


def _rate(what: str, config: Config, n: int, model: mujoco.MjModel, data: mujoco.MjData) -> Row:
    return measure(what, config.repeats, n, lambda: mujoco.mj_step(model, data, nstep=n))
