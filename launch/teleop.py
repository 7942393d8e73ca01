"""Lead the bead along the wire with keys, and record it as an episode like any other demonstration.

A key pushes the compliant hand, and the wire guides it. Ctrl-C ends; finished episodes are on disk.
"""

import shutil
import sys
import time
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from touchgoal.runtime.option_types import Count, Seed, checked_dataclass
from touchgoal.sim_envs.config import BeadMazeConfig, TeleoperatorConfig

if TYPE_CHECKING:
    from touchgoal.control.sensors.keyboard import Keyboard
    from touchgoal.episodes.recording import EpisodeSpec
    from touchgoal.episodes.schema import Episode
    from touchgoal.sim_envs.bead_maze import BeadMaze

_GIVE_UP_KEY = "q"


@checked_dataclass
class Config:
    """Options of teleop."""

    task: Literal["bead-maze"] = "bead-maze"
    """Task to demonstrate."""
    out: Path | None = None
    """Folder of the run; the episodes go to its `episodes/`, after those already there."""
    episodes: Count = 1
    """Number of attempts to lead the bead along a wire; those given up count."""
    seed: Seed = 0
    """Random seed of the first episode; each further one adds one."""
    hand: TeleoperatorConfig = field(default_factory=TeleoperatorConfig)
    """Response of the hand to keys."""
    env: BeadMazeConfig = BeadMazeConfig(max_seconds=300.0, stall_seconds=60.0)
    """Options of the task; time limits suit a person. The wire arc-2000009 is nearly straight."""


def main(config: Config) -> None:
    """Offer the wires one by one, save the finished episodes, report them."""
    from touchgoal.control.sensors.keyboard import Keyboard
    from touchgoal.episodes.recording import EpisodeSpec, check_fits
    from touchgoal.episodes.store import EpisodeWriter
    from touchgoal.runtime.errors import UserError
    from touchgoal.runtime.json_file import write_json
    from touchgoal.runtime.run_folder import open_run
    from touchgoal.sim_envs.bead_maze import BeadMaze
    from touchgoal.sim_envs.experts.teleoperator import HELP

    wires = config.env.chosen_wires(config.episodes)
    if sys.stdin is None:
        raise UserError("there is no keyboard to read: start it in a terminal")
    with Keyboard(sys.stdin) as keyboard:
        out = open_run(config.out, "teleop", config, adds=True)
        writer, metas = EpisodeWriter(out / "episodes", fps=config.env.control_hz), []
        check_fits(writer, config.env)
        env = BeadMaze(config.env)
        try:
            for i, wire in enumerate(wires):
                print(f"{wire.name}, {i + 1} of {config.episodes}: {HELP}  q give up  Ctrl-C end")
                spec = EpisodeSpec(config.seed + i, options={"wire": wire.name})
                episode = _record_attempt(env, spec, keyboard, config.hand)
                if episode is None:
                    print("\ngiven up: not saved")
                    continue
                failed = ", ".join(env.failures()) or "out of time"
                print(f"\n{'arrived' if episode.meta['success'] else failed}: saving")
                writer.append(episode)
                metas.append(episode.meta)
        finally:
            env.close()
            write_json(out / "metrics.json", {"episodes": metas})
            done = sum(bool(meta["success"]) for meta in metas)
            saved = f"{len(metas)} of {config.episodes} episodes saved, {done} to the wire's end"
            print(f"\n{saved}: {out / 'episodes'}")


def _record_attempt(
    env: "BeadMaze", spec: "EpisodeSpec", keyboard: "Keyboard", config: TeleoperatorConfig
) -> "Episode | None":
    """Return the episode that a person leads to its end, good or bad; None if they give it up."""
    import numpy as np

    from touchgoal.control import features as ft
    from touchgoal.episodes.recording import run, to_episode
    from touchgoal.sim_envs.experts.teleoperator import HELP, Teleoperator

    observation, info = env.reset(seed=spec.seed, options=spec.options)
    keyboard.read_keys()  # drop keys typed for the last wire
    hand, ticks, due = Teleoperator(env, config), [], time.monotonic()
    for tick in run(env, hand, observation, info):
        ticks.append(tick)
        keys = keyboard.read_keys()
        if _GIVE_UP_KEY in keys:
            return None
        hand.press(keys)
        progress, force = tick[ft.TRUTH_PROGRESS][0], np.linalg.norm(tick[ft.WRENCH][:3])
        status = f"{progress:4.0%} of the way  {force:4.1f} N on the hand"
        _show(f"{status}  {hand.held or 'still':<6}{HELP}")
        now = time.monotonic()
        due = max(due + 1 / env.config.control_hz, now)  # lost time is not made up for
        time.sleep(due - now)
    return to_episode(env, ticks, spec)


def _show(line: str) -> None:
    if sys.stdout.isatty():
        width = shutil.get_terminal_size().columns - 1
        print(f"\r{line[:width]:<{width}}", end="", flush=True)
