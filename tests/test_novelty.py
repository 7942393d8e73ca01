"""Novelty of embeddings: those off the training's plane."""

import torch
from toy_policies import torch_rng

from touchgoal.policies.perception.novelty import NoveltyDetector

TICKS = 10
PLANE = torch.linalg.qr(torch.randn(8, 4, generator=torch_rng()))[0].T


def episodes(n: int, seed: int) -> torch.Tensor:
    """Embeddings (n, 30, 8) near a plane of four dimensions, each episode at a place of its own."""
    rng = torch_rng(seed)
    places = torch.randn(n, 1, 4, generator=rng) + 0.3 * torch.randn(n, 30, 4, generator=rng)
    return places @ PLANE + 0.05 * torch.randn(n, 30, 8, generator=rng)


def fitted(training: torch.Tensor) -> NoveltyDetector:
    detector = NoveltyDetector(8)
    detector.fit(training.flatten(0, 1), [30] * len(training), TICKS)
    return detector


def novel(detector: NoveltyDetector, embedded: torch.Tensor) -> bool:
    return bool((detector(embedded) > 1).unfold(0, TICKS, 1).all(1).any())


def test_one_episode_in_twenty_is_novel_and_all_off_the_plane_are() -> None:
    alarms = 0
    for seed in range(10):
        training, new = episodes(200, seed), episodes(200, seed + 10_000)
        detector = fitted(training)
        assert sum(novel(detector, episode) for episode in training[1::2]) == 4  # (100 + 1) 5 % - 1
        alarms += sum(novel(detector, episode) for episode in new)
        off = torch.randn(8, generator=torch_rng(seed))
        off -= off @ PLANE.T @ PLANE
        assert all(novel(detector, episode + off / off.norm()) for episode in new)
    assert alarms <= 168  # 5 % of 2,000, and four deviations: limits vary, too, as Beta(5, 96)


def test_few_episodes_set_no_limit() -> None:
    assert fitted(episodes(37, 0))(torch.full((1, 8), 100.0)) == 0
    assert fitted(episodes(38, 0))(torch.full((1, 8), 100.0)) > 1
