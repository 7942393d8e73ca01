"""The MMWand twin: its catalogue, its touches, their recording, and the green screen."""

from contextlib import closing
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from in_process import in_process_workers

from touchgoal.control import features as ft
from touchgoal.control.wand_touch import MAX_FORCE
from touchgoal.encoders.alignment.green_screen import (
    background_changer,
    foreground,
    random_background,
    replace_background,
)
from touchgoal.episodes.wand import recording as wand_recording
from touchgoal.episodes.wand.recording import record_touches
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.parallel.shard import Shard
from touchgoal.sim_envs.scene.rendering import open_renderer
from touchgoal.sim_envs.touch_wand import Touch, TouchWand
from touchgoal.sim_envs.wand.bench import GREEN, VIEWS


def touch_once(env: TouchWand, seed: int = 0, force: float | None = None) -> Touch:
    env.reset(seed=seed)
    while True:
        env.move_object()
        action = env.random_action()
        if force is not None:
            action[5] = 2 * force / MAX_FORCE - 1
        if (touch := env.touch(action)) is not None:
            return touch


def test_gymnasium_contract() -> None:
    env = gym.make("touchgoal/TouchWand-v0", views=False)
    check_env(env.unwrapped, skip_render_check=True)
    env.reset(seed=0, options={"object": "key"})
    assert env.unwrapped.object.name == "key"  # pyright: ignore[reportAttributeAccessIssue]
    env.close()


def test_a_touch_is_the_same_for_a_seed_and_carries_its_force() -> None:
    env = TouchWand(object="pineapple", views=False)
    one, again, other = (touch_once(env, seed, 12.0) for seed in (3, 3, 4))
    env.close()
    np.testing.assert_array_equal(one.clip, again.clip)
    assert (one.clip != other.clip).any()
    np.testing.assert_allclose(one.wrench[:, 2], -one.load, atol=1e-3)  # Newton's third law
    assert one.load[0] == 0 and one.load[-1] == pytest.approx(12.0)


def test_recording_resumes_to_the_same_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wand_recording, "TOUCHES_A_VISIT", 2)
    count = 4
    with in_process_workers():
        record_touches(tmp_path / "part", "gelsight_mini", 5, 1, 1)
        resumed = record_touches(tmp_path / "part", "gelsight_mini", 5, count, 1)
        whole = record_touches(tmp_path / "whole", "gelsight_mini", 5, count, 1)
        given = "gelsight_mini", 5, 3, 1
        shards = [record_touches(tmp_path / f"{i}", *given, Shard(i, 2)) for i in (0, 1)]
        with pytest.raises(UserError, match="another shard's episodes"):
            record_touches(tmp_path / "0", "gelsight_mini", 5, count, 1, Shard(1, 2))
    assert len(resumed) == len(whole) == count and resumed.checksum == whole.checksum
    parts = [(part, i) for part in shards for i in range(len(part))]
    assert [part.episode_checksum(i) for part, i in parts] == [
        whole.episode_checksum(i) for i in range(3)
    ]
    assert {str(whole.meta(i)["object"]) for i in range(count)} == {"apple", "clementine"}
    touch = whole.read(0, [*ft.WAND_VIEWS, ft.TACTILE_LEFT, ft.LOAD]).frames
    top = touch[ft.WAND_VIEWS[0]]
    assert (top[0] == top[1]).all() and (top[1] != top[2]).any()  # the wand arrives once
    assert touch[ft.LOAD][0] == 0 < touch[ft.LOAD][-1] <= MAX_FORCE
    with pytest.raises(UserError, match="holds other touches"):
        record_touches(tmp_path / "whole", "gelsight_mini", 6, count, 1)


@pytest.mark.parametrize("name", ["apple", "cucumber", "wine_glass", "rice"])
def test_the_green_screen_is_cut_out(name: str) -> None:
    """Against MuJoCo's own segmentation; a green object stays whole, shadows go."""
    env = TouchWand(object=name)
    touch = touch_once(env, 3)
    model = env.bench.model
    green = (np.abs(model.geom_rgba[:, :3] - GREEN).max(1) < 1e-3) & (model.geom_matid < 0)
    green = np.append(green, True)  # -1: no geom
    with closing(open_renderer(model, *touch.views["top"].shape[:2])) as renderer:
        renderer.enable_segmentation_rendering()
        for view in VIEWS:
            renderer.update_scene(env.bench.data, view, env.bench.shown)
            solid = ~green[renderer.render()[..., 0]]
            found = foreground(touch.views[view]) > 0.5
            assert (solid & found).sum() / (solid | found).sum() >= 0.98, view
    behind = random_background(np.random.default_rng(0))
    free = foreground(touch.views["top"]) == 0
    mixed = replace_background(touch.views["top"], behind)
    np.testing.assert_array_equal(mixed[free], behind[free])
    env.close()
    with pytest.raises(UserError, match="no green screen"):
        foreground(np.full((64, 64, 3), 200, np.uint8))
    covered = np.full((64, 64, 3), (200, 40, 40), np.uint8)
    change = background_changer("generated", 0)
    with pytest.raises(UserError, match="no green screen"):
        change(covered)
    change(touch.views["top"])  # now the screen's colour is known
    np.testing.assert_array_equal(change(covered), covered)
