"""What `action` means is read off the states that follow, converted, or refused by name."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from touchgoal.control import features as ft
from touchgoal.control.motion.arm_models import FR3_ARM
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.launch.train_policy import Config, main
from touchgoal.policies.training.action_meaning import ActionMeaning, check_actions, joint_changes
from touchgoal.runtime.errors import UserError

HOME = np.array(FR3_ARM.home)


def demonstration(seed: int, n: int = 80) -> tuple[np.ndarray, np.ndarray]:
    """State and action of an arm that follows two ticks late, stands still, then presses in vain."""
    rng = np.random.default_rng(seed)
    velocity = np.cumsum(rng.normal(0, 0.004, (n, 7)), 0)
    velocity[20:40] = 0.0
    change = np.clip(velocity, -0.05, 0.05).astype(np.float32)
    commanded = HOME + np.cumsum(change, 0)
    measured = np.concatenate([np.tile(HOME, (3, 1)), commanded[:-3]])
    measured[-8:] = measured[-8]
    width = np.where(np.arange(n) < 50, 0.08, 0.03)[:, None]
    state = np.concatenate([measured, np.zeros((n, 7)), width], 1).astype(np.float32)
    return state, np.concatenate([change, width], 1).astype(np.float32)


def absolute(state: np.ndarray, action: np.ndarray) -> np.ndarray:
    return np.concatenate([state[0, :7] + np.cumsum(action[:, :7], 0), action[:, 7:]], 1)


def relative(state: np.ndarray, action: np.ndarray) -> np.ndarray:
    return np.concatenate([np.cumsum(action[:, :7], 0), action[:, 7:]], 1)


def scaled(factor: float, width: float = 1.0) -> Callable:
    return lambda state, action: action * np.array([factor] * 7 + [width], np.float64)


def degrees(state: np.ndarray, action: np.ndarray) -> np.ndarray:
    return absolute(state, action) * np.append(np.full(7, np.rad2deg(1)), 1)


KINDS = {
    "as ours": (lambda state, action: action, "change", ""),
    "absolute": (absolute, "change", "are absolute joint positions: pass --actions absolute"),
    "absolute, converted": (absolute, "absolute", ""),
    "relative": (relative, "change", "since the episode's start: pass --actions relative"),
    "relative, converted": (relative, "relative", ""),
    "ours taken for absolute": (lambda s, a: a, "absolute", "per tick: leave out --actions"),
    "degrees": (degrees, "change", "positions in degrees: store radians"),
    "changes in degrees": (scaled(180 / np.pi), "change", "tick in degrees: store radians"),
    "velocities": (scaled(20), "change", "are joint velocities: store the joint change"),
    "gripper 0..1": (scaled(1, 12.5), "change", "gripper goes from 0.03 to 1, which is no width"),
    "nonsense": (
        lambda s, a: a + np.array([3.0, -2.0, 1.0, 4.0, 3.0, 5.0, 2.0, 0.0]),
        "change",
        "are no joint change",
    ),
}


def write_set(root: Path, seeds: range, kind: str) -> EpisodeSet:
    writer = EpisodeWriter(root)
    for seed in seeds:
        state, action = demonstration(seed)
        stored = KINDS[kind][0](state, action).astype(np.float32)
        pose = np.full((len(state), 7), 0.5, np.float32)
        frames = {ft.STATE: state, ft.TCP_POSE: pose, ft.ACTION: stored}
        writer.append(Episode(frames, "lift", {"success": True, "task": "lift"}))
    writer.close()
    return EpisodeSet(root)


@pytest.mark.parametrize("kind", KINDS)
def test_actions_are_what_the_states_say(tmp_path: Path, kind: str) -> None:
    episodes, (_, given, message) = write_set(tmp_path, range(3), kind), KINDS[kind]
    meaning: ActionMeaning = given
    if message:
        with pytest.raises(UserError, match=message) as refusal:
            check_actions(episodes, range(3), meaning)
        assert "\n" not in str(refusal.value)
        return
    assert check_actions(episodes, range(3), meaning).endswith("gripper in m")
    state, action = demonstration(1)
    converted = joint_changes(episodes.read(1).frames[ft.ACTION], state, meaning)
    np.testing.assert_allclose(converted, action, atol=1e-6)


@pytest.mark.slow
def test_a_set_of_absolute_joints_is_refused_or_converted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for kind in ("absolute", "as ours"):
        write_set(tmp_path / kind / "data", range(2), kind)
        write_set(tmp_path / kind / "validation", range(2, 4), kind)

    def train(kind: str, meaning: ActionMeaning) -> str:
        folder, out = tmp_path / kind, tmp_path / f"{kind}-{meaning}"
        options = {"head": "tiny", "trials": 0, "out": out, "actions": meaning}
        main(Config(folder / "data", folder / "validation", **options))
        printed = capsys.readouterr().out
        return next(line for line in printed.splitlines() if "planned joint change" in line)

    with pytest.raises(UserError, match="absolute"):
        train("absolute", "change")
    assert train("absolute", "absolute") == train("as ours", "change")
