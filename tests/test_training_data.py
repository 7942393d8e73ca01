"""What makes recorded data unfit to train on: shared validation frames, pauses at the start."""

from pathlib import Path

import numpy as np
import pytest
from toy_episodes import FPS, make_episode

from touchgoal.control import features as ft
from touchgoal.episodes.overlap import require_no_shared_frames
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.policies.training.training_data import leading_pause
from touchgoal.runtime.errors import UserError


def write(root: Path, episodes: list[Episode]) -> EpisodeSet:
    writer = EpisodeWriter(root, FPS)
    for episode in episodes:
        writer.append(episode)
    return EpisodeSet(root)


def part(episode: Episode, keys: tuple[str, ...], rows: slice = slice(None)) -> Episode:
    return Episode({key: episode.frames[key][rows] for key in keys}, episode.task)


@pytest.mark.parametrize(
    "keys", [(ft.STATE, ft.ACTION), (ft.TACTILE_LEFT,)], ids=["state", "touch"]
)
def test_validation_frames_that_are_trained_on_are_refused(tmp_path: Path, keys) -> None:
    whole = [part(make_episode(seed, 20), keys) for seed in range(4)]
    train = write(tmp_path / "a", whole[:3])
    require_no_shared_frames(train, write(tmp_path / "b", whole[3:]))
    reordered = [whole[3], part(make_episode(1, 20), keys, slice(None, None, -2))]
    with pytest.raises(UserError, match="episode 1 of .* shares 10 frames with episode 1 of"):
        require_no_shared_frames(train, write(tmp_path / "c", reordered))


def test_a_common_resting_start_is_no_overlap(tmp_path: Path) -> None:
    episodes = [part(make_episode(seed, 40), (ft.STATE, ft.ACTION)) for seed in range(2)]
    for episode in episodes:
        episode.frames[ft.STATE][:15] = 0.5
    train, validation = (write(tmp_path / str(i), [e]) for i, e in enumerate(episodes))
    require_no_shared_frames(train, validation)


def test_a_pause_at_the_start_is_found() -> None:
    state, action = np.zeros((30, 15), np.float32), np.zeros((30, 8), np.float32)
    action[:, 7], state[:, 14] = 0.08, 0.08
    state[:, 0] += np.random.default_rng(0).normal(0, 1e-4, 30)  # encoder noise is no motion
    still = Episode({ft.STATE: state, ft.ACTION: action}, "wait")
    moving = Episode({ft.STATE: state.copy(), ft.ACTION: action.copy()}, "wait, then go")
    moving.frames[ft.ACTION][12:, 1] = 0.01
    closing = Episode({ft.STATE: state, ft.ACTION: action.copy()}, "wait, then close")
    closing.frames[ft.ACTION][5:, 7] = 0.0
    assert [leading_pause(episode) for episode in (still, moving, closing)] == [0, 12, 5]
