"""Fragile carry: what holds one rod crushes another, and slip says which one it is."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from in_process import run, run_benchmark

from touchgoal.control import features as ft
from touchgoal.episodes.recording import EpisodeSpec, record_episode
from touchgoal.sim_envs.config import FragileCarryConfig
from touchgoal.sim_envs.experts.fragile_carry import FragileCarryExpert
from touchgoal.sim_envs.fragile_carry import FragileCarry, width_for


@pytest.fixture(scope="module")
def env() -> Iterator[FragileCarry]:
    env = FragileCarry(FragileCarryConfig(tactile=False))
    yield env
    env.close()


def carry(env: FragileCarry, hold_force: float, force: float | None = None) -> list[str]:
    """Return what failed; the expert moves the hand, with its own force or a constant one (N)."""
    env.reset(seed=0, options={"hold_force": hold_force})
    expert = FragileCarryExpert(env)
    while True:
        action = expert.act({})
        if force is not None:
            action[-1] = width_for(force)
        _, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            break
    assert bool(info[ft.TRUTH_SUCCESS]) == (not env.failures())
    return env.failures()


@pytest.mark.parametrize("hold_force", [1.0, 2.8, 8.0])
def test_expert_carries_every_rod(env: FragileCarry, hold_force: float) -> None:
    assert not carry(env, hold_force)


@pytest.mark.parametrize(
    ("hold_force", "failed"), [(1.0, "crushed"), (2.8, ""), (4.0, "tilted"), (8.0, "dropped")]
)
def test_one_force_does_not_fit_all(env: FragileCarry, hold_force: float, failed: str) -> None:
    assert carry(env, hold_force, force=4.5) == [failed] * bool(failed)


def test_expert_recovers_from_a_disturbed_squeeze() -> None:
    env = FragileCarry(FragileCarryConfig(tactile=False, disturbance=0.002))
    episode = record_episode(env, EpisodeSpec(seed=1))
    assert episode.meta["success"] and episode.meta["task"] == "fragile-carry"
    assert np.ptp(episode.frames[ft.STATE][30:, -1]) > 0  # the width varies
    touched = np.flatnonzero(episode.frames[ft.TRUTH_CONTACT].any(1))
    assert 5 < touched[0] < 10, "the first frames are the fingertips' background"


def test_commands_from_demonstrations_to_a_table(tmp_path: Path, capsys) -> None:
    one = ("--workers", 1)
    data, val, policy = (tmp_path / name for name in ("data", "val", "policy"))
    record = ("collect-demos", "--task", "fragile-carry", "--episodes", 1, *one)
    run(*record, "--out", data)
    run(*record, "--seed", 1, "--out", val)
    run("train-policy", "--data", data / "episodes", "--validation", val / "episodes", "--out", policy,
        "--head", "regression", "--representation", "base_twist", "--hand-force", "--train.epochs", 1,
        "--trials", 0, *one)  # fmt: skip
    run_benchmark("fragile-carry", "--policies", policy / "policy", "--episodes", 1, "--env.max-seconds", 1,
        *one, "--out", tmp_path / "table")  # fmt: skip
    printed = capsys.readouterr().out
    assert re.search("^state, force on the hand +0/1 ", printed, re.M)


@pytest.mark.slow
def test_a_grip_is_found_by_touch(tmp_path: Path) -> None:
    """Of three forces the least loses this rod, and the largest crushes it unseen."""
    sizes = "--rods 1 --seed 3895002 --forces 3 --goals 2 --searches 2 --samples 6 --workers 1"
    run_benchmark("grip-search", *sizes.split(), "--out", tmp_path / "found")
    found = json.loads((tmp_path / "found" / "metrics.json").read_text())
    assert set(found["ends"]["touch"]["18"]) == {"safe"}
    table = sorted((tmp_path / "found" / "trials").glob("rod-*"))
    assert len(table) == 3
    before = [file.stat().st_mtime_ns for file in table]
    run_benchmark("grip-search", *sizes.split(), "--out", tmp_path / "found")
    assert [file.stat().st_mtime_ns for file in table] == before, "kept, not recorded anew"
