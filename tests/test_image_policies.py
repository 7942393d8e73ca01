"""Policies that see by cameras: feature maps, and the way from recordings to actions."""

from pathlib import Path

import numpy as np
import pytest
from test_commands import refused, run

from touchgoal.control import features as ft
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies.checkpoint import load_policy
from touchgoal.policies.perception.frozen_images import ImageEmbedder, ImageInputConfig
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.config import PickPlaceConfig

pytestmark = pytest.mark.usefixtures("in_process")


def test_a_tick_embeds_like_its_episode_and_another_size_is_refused() -> None:
    images = np.random.default_rng(0).integers(0, 256, (5, 64, 96, 3), np.uint8)
    embedder = ImageEmbedder(ImageInputConfig((ft.FRONT, ft.WRIST), (64, 96)))
    together = embedder._maps(images)
    alone = embedder.embed_tick({ft.FRONT: images[4], ft.WRIST: images[0]})
    assert alone.shape == embedder.shape == (2, 112, 14, 21)
    np.testing.assert_allclose(alone, together[[4, 0]], atol=2e-2)
    with pytest.raises(UserError, match="camera images are 64 x 64, the policy reads 64 x 96"):
        embedder.embed_tick({ft.FRONT: images[0, :, :64], ft.WRIST: images[0]})


@pytest.mark.slow
def test_from_recordings_with_cameras_to_a_policy_that_sees(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    record = ("collect-demos", "--episodes", 1, "--env.control-hz", 10, "--env.no-tactile", "--env.camera-size", 64, 64,
              "--workers", 1)  # fmt: skip
    run(*record, "--out", "demos")
    run(*record, "--seed", 1, "--out", "val")
    learn = ("train-policy", "--data", "demos", "--validation", "val", "--workers", 1, "--head", "tiny",
             "--representation", "base_twist", "--train.epochs", 1, "--trials", 0)  # fmt: skip
    assert "its cameras: observation.images.front" in refused(capsys, *learn, "--cameras", "top")
    run(*learn, "--cameras", "front", "wrist", "--out", "policy")
    policy = load_policy("policy")
    env = policy.env_config(PickPlaceConfig(control_hz=10))
    assert env.cameras == ("front", "wrist") and env.camera_size == (64, 64) and not env.tactile
    recorded = EpisodeSet(Path("demos/episodes")).read(0).frames
    seen = {key: values[0] for key, values in recorded.items()}
    moved = policy.act(seen)
    policy.reset()
    blind = policy.act(seen | {ft.FRONT: np.zeros_like(seen[ft.FRONT])})
    assert moved.shape == (8,) and not np.array_equal(moved, blind)
