"""What `touchgoal teleop` does."""

import shutil
import sys
import time

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.sensors.keyboard import Keyboard
from touchgoal.episodes.recording import EpisodeSpec, run, to_episode
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeWriter
from touchgoal.launch.teleop import Config
from touchgoal.runtime.run_folder import open_run, write_json
from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.config import TeleoperatorConfig
from touchgoal.sim_envs.experts.teleoperator import HELP, Teleoperator

_GIVE_UP_KEY = "q"


def run_command(config: Config) -> None:
    """Offer the wires one by one, keep what is finished, say what came of it."""
    wires = config.env.chosen_wires(config.episodes)
    with Keyboard(sys.stdin) as keyboard:
        out = open_run(config.out, "teleop", config, adds=True)
        writer, metas = EpisodeWriter(out / "episodes", fps=config.env.control_hz), []
        env = BeadMaze(config.env)
        try:
            for i, wire in enumerate(wires):
                print(f"{wire.name}, {i + 1} of {config.episodes}: {HELP}  q give up  Ctrl-C end")
                job = EpisodeSpec(config.seed + i, options={"wire": wire.name})
                episode = record_attempt(env, job, keyboard, config.hand)
                if episode is None:
                    print("\ngiven up: not kept")
                    continue
                failed = ", ".join(env.failures()) or "out of time"
                ending = "arrived" if episode.meta["success"] else failed
                print(f"\n{ending}: saving")
                writer.append(episode)
                metas.append(episode.meta)
        finally:
            env.close()
            write_json(out / "metrics.json", {"episodes": metas})
            done = sum(bool(meta["success"]) for meta in metas)
            kept = f"{len(metas)} of {config.episodes} episodes kept, {done} to the wire's end"
            print(f"\n{kept}: {out / 'episodes'}")


def record_attempt(
    env: BeadMaze, job: EpisodeSpec, keyboard: Keyboard, config: TeleoperatorConfig
) -> Episode | None:
    """The episode that a person leads to its end, good or bad; None if they give it up.

    Raises:
        KeyboardInterrupt: they typed Ctrl-C.
    """
    observation, info = env.reset(seed=job.seed, options=job.options)
    keyboard.read_keys()  # what was meant for the last wire
    hand, ticks, due = Teleoperator(env, config), [], time.monotonic()
    for tick in run(env, hand, observation, info):
        ticks.append(tick)
        keys = keyboard.read_keys()
        if _GIVE_UP_KEY in keys:
            return None
        hand.press(keys)
        _show_status(tick, hand.held)
        now = time.monotonic()
        due = max(due + 1 / env.config.control_hz, now)  # what was late is not made up for
        time.sleep(due - now)
    return to_episode(env, ticks, job)


def _show_status(tick: dict[str, np.ndarray], held: str) -> None:
    """One line that is written over."""
    if sys.stdout.isatty():
        progress, force = tick[ft.TRUTH_PROGRESS][0], np.linalg.norm(tick[ft.WRENCH][:3])
        line = f"{progress:4.0%} of the way  {force:4.1f} N on the hand  {held or 'still':<6}{HELP}"
        width = shutil.get_terminal_size().columns - 1
        print(f"\r{line[:width]:<{width}}", end="", flush=True)
