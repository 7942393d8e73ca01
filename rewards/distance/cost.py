"""Cost of an embedded trajectory to a goal: its parts, and MMWand's plain distances (section V-E).

Plain distances are cosine distances, 1 - cos, in [0, 2]; touch is averaged over the fingertips. The
distance to a force goal is a share of it, 1 without contact; as the unit of its part, half of it counts.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float32

from touchgoal.rewards.curves import Curves
from touchgoal.rewards.distance.normalizer import DistanceNormalizer
from touchgoal.rewards.distance.parts import (
    FORCE,
    VALUE,
    WORDS,
    Costs,
    cosine_distances,
    force_distances,
    part_costs,
    smooth_and_fuse,
    soft_minimum,
    touch_distances,
)
from touchgoal.rewards.features.embedded import (
    IMAGE,
    TEXT,
    TOUCH,
    EmbeddedEpisode,
    EmbeddedGoal,
    Features,
)
from touchgoal.rewards.value import Value

_FORCE_UNIT = 0.5  # share of a force goal: without force, or with twice as much, it costs 0.64


def compute_curves(
    episode: EmbeddedEpisode,
    goal: EmbeddedGoal,
    normalizer: DistanceNormalizer | None,
    value: Value | None = None,
    before: Mapping[str, float] | None = None,
    plain: bool = False,
) -> Curves:
    """Return the curves of one trajectory to one goal; raw distances alone without a normalizer.

    `before` holds the costs of the parts at the previous frame, if the trajectory comes in pieces;
    with `plain` the parts are left out. UserError: the normalizer lacks a modality or was fitted for
    something else.
    """
    # normalizers were fitted on the distances of incomplete touches
    raw = plain_distances(episode.features, goal.features, completed=normalizer is None)
    units = dict(normalizer.unit) if normalizer is not None and not plain else {}
    if FORCE in goal.forms:
        wanted = goal.features[FORCE]
        newtons = float(wanted.mean())
        raw[FORCE] = force_distances(episode.features[FORCE], wanted)[:, 0] / newtons
        units = units and units | {FORCE: _FORCE_UNIT * newtons}
    normalised: Costs = {}
    parts: Costs = {}
    if normalizer is not None:
        about = episode.made_with, goal.same_episode
        normalised = normalizer.normalise(raw, *about, parts=bool(units))
    if units:
        parts = part_costs(episode.features, goal.features, units)
        if value is not None:
            parts[VALUE] = 1 - value.progress(episode.features)
        if "text" in normalised:
            parts[WORDS] = np.clip(normalised["text"], 0, 1)
        parts = smooth_and_fuse(parts, episode.fps, before)
    about = episode.source, goal.forms, episode.fps, episode.contact
    return Curves(*about, raw, normalised, parts, goal.same_episode.intersection(raw))


def plain_distances(mine: Features, goal: Features, completed: bool) -> Costs:
    """Return the raw cosine distance per frame, for each modality that has a goal.

    With `completed`, touch is completed to unit length first (see `complete`).
    """
    raw = {}
    if IMAGE in goal:
        raw["image"] = soft_minimum(cosine_distances(mine[IMAGE], goal[IMAGE]))
    if TOUCH in goal:
        touch, goals = (complete(f[TOUCH]) if completed else f[TOUCH] for f in (mine, goal))
        raw["tactile"] = soft_minimum(touch_distances(touch, goals))
    if TEXT in goal:
        raw["text"] = soft_minimum(cosine_distances(mine[TOUCH].mean(1, np.float64), goal[TEXT]))
    return raw


def complete(touch: Float32[np.ndarray, "*n k"]) -> Float32[np.ndarray, "*n k+1"]:
    """Return embeddings completed to unit length by a coordinate of their own.

    Whitened embeddings are as short as the touch is faint, and 0 without contact. Equal touches are
    then at distance 0, untouched fingertips among them.
    """
    missing = 1 - np.square(touch).sum(-1, keepdims=True)
    return np.concatenate([touch, np.sqrt(np.maximum(missing, 0))], -1)
