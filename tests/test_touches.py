from pathlib import Path

import numpy as np
import pytest

from touchgoal.control import features as ft
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.episodes.touches import collect_touches
from touchgoal.runtime.errors import UserError


def touch_episode(seed: int, truth: bool) -> Episode:
    """Contact from frame 20 on the left and 25 on the right; none at all in episode 2."""
    n, rng = 40, np.random.default_rng(seed)
    y, x = np.mgrid[:96, :128]
    bump = np.exp(-((x - 60) ** 2 + (y - 50) ** 2) / 200)[..., None] * [30, -20, 10]
    contact = np.arange(n)[:, None] >= [20, 25] if seed != 2 else np.zeros((n, 2), bool)
    frames: dict[str, np.ndarray] = {}
    frames[ft.WRIST] = np.tile(np.arange(n, dtype=np.uint8)[:, None, None, None] * 6, (16, 16, 3))
    for side, key in enumerate(ft.TACTILE):
        gel = 100 + 20 * seed + 5 * side + rng.normal(0, 1, (n, 96, 128, 3))
        frames[key] = (gel + contact[:, side, None, None, None] * bump).astype(np.uint8)
    if truth:
        frames[ft.TRUTH_CONTACT] = contact
    descriptions = [f"feels like {seed}", "hard"]
    return Episode(frames, "touch", {"object": f"thing_{seed}", "descriptions": descriptions})


@pytest.mark.parametrize("truth", [True, False])
def test_touches(tmp_path: Path, truth: bool) -> None:
    writer = EpisodeWriter(tmp_path)
    for seed in range(3):
        writer.append(touch_episode(seed, truth))
    episodes = EpisodeSet(tmp_path)
    touches = collect_touches(
        episodes, contact_frames_per_episode=8, no_contact_frames_per_episode=3, seed=0
    )
    assert len(touches) == 2 * (8 + 3) + 3
    assert [touches.object.count(name) for name in ("thing_0", "thing_1", "")] == [8, 8, 9]
    assert len(touches.background) == 2 * len(touches.view) == 6
    assert touches.descriptions["thing_1"] == ["feels like 1", "hard"]
    bumped = touches.frames.astype(int) - touches.background[touches.background_index]
    touched = bumped[:, 50, 60, 0] > 15
    assert touched.tolist() == [name != "" for name in touches.object]
    assert np.abs(bumped[~touched].mean(axis=(1, 2, 3))).max() < 2, "the background is its own"
    # the last frame before contact is 19; five frames earlier the wrist picture is 14 * 6 bright
    assert touches.view[:2].mean(axis=(1, 2, 3)) == pytest.approx(14 * 6, abs=3)
    np.testing.assert_array_equal(touches.view_index, touches.background_index // 2)
    again = collect_touches(episodes, 8, 3, seed=0)
    np.testing.assert_array_equal(again.frames, touches.frames)
    assert (collect_touches(episodes, 8, 3, seed=1).frames != touches.frames).any()


def test_touches_need_touch_and_names(tmp_path: Path) -> None:
    episode = touch_episode(2, truth=True)
    EpisodeWriter(tmp_path / "untouched").append(episode)
    with pytest.raises(UserError, match="has no contact"):
        collect_touches(EpisodeSet(tmp_path / "untouched"), 8, 3, seed=0)
    EpisodeWriter(tmp_path / "unnamed").append(Episode(episode.frames, "touch", {}))
    with pytest.raises(UserError, match="lacks meta descriptions, object"):
        collect_touches(EpisodeSet(tmp_path / "unnamed"), 8, 3, seed=0)
