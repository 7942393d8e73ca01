"""Distance of a trajectory to a goal in embedding space (MMWand, section V-E, with touch).

All distances are cosine distances, 1 - cos, in [0, 2]; touch is averaged over the fingertips.
"""

import numpy as np
from jaxtyping import Float, Float32

from touchgoal.rewards.curves import Curves
from touchgoal.rewards.distance.normalizer import DistanceNormalizer
from touchgoal.rewards.features.embedded import EmbeddedEpisode, EmbeddedGoal


def compute_distances(
    episode: EmbeddedEpisode, goal: EmbeddedGoal
) -> dict[str, Float[np.ndarray, " n"]]:
    """Return the raw cosine distance per frame, for each modality that has a goal."""
    raw = {}
    if goal.image is not None:
        raw["image"] = image_distances(episode.pictures(), goal.image[None])[:, 0]
    if goal.touch is not None:
        raw["tactile"] = touch_distances(episode.touches(), goal.touch[None])[:, 0]
    if goal.text is not None:
        raw["text"] = text_distances(episode.touches(), goal.text[None])[:, 0]
    return raw


def compute_curves(
    episode: EmbeddedEpisode, goal: EmbeddedGoal, normalizer: DistanceNormalizer | None
) -> Curves:
    """Return the curves of one trajectory to one goal; without a normalizer raw, and none fused.

    UserError: the normalizer lacks a modality or was fitted for something else.
    """
    raw = compute_distances(episode, goal)
    same = goal.same_episode
    normalised = normalizer.normalise(raw, episode.made_with, same) if normalizer else {}
    return Curves(
        episode.source,
        goal.forms,
        episode.fps,
        episode.contact,
        raw,
        normalised,
        same.intersection(raw),
    )


def image_distances(
    image: Float32[np.ndarray, "n d"], goals: Float32[np.ndarray, "g d"]
) -> Float[np.ndarray, "n g"]:
    """Return the cosine distance of each image to each goal."""
    return 1 - image.astype(np.float64) @ goals.astype(np.float64).T


def touch_distances(
    touch: Float32[np.ndarray, "sides n k"], goals: Float32[np.ndarray, "g sides k"]
) -> Float[np.ndarray, "n g"]:
    """Return the distance of each touch to each goal's same fingertip, mean over the fingertips."""
    cosine = np.einsum("snk,gsk->ng", touch, goals, dtype=np.float64)
    return 1 - cosine / len(touch)


def text_distances(
    touch: Float32[np.ndarray, "sides n k"], goals: Float32[np.ndarray, "g k"]
) -> Float[np.ndarray, "n g"]:
    """Return the distance of each touch to each sentence, mean over the fingertips."""
    return 1 - np.mean(touch, axis=0, dtype=np.float64) @ goals.astype(np.float64).T
