"""Named parts of a cost: what each one measures, its distance to a goal, and how they are fused.

A part's cost is d^2 / (d^2 + (1.5 unit)^2), with its distance d to the goal and, as the unit, the
spread of d among successful ends of the same object: 0 is the goal, 0.3 the spread of successes, 1
far away. The unit is a normalizer's, or the spread of the goals themselves if that is larger: some
objects are held less alike than others. A fingertip part costs its no-contact value until contact
is detected, with hysteresis (`ContactReader`): before contact only the other parts can lower the
fused cost.

    front, wrist  pooled features of the camera of that name
    wrist_map     worst cells of the wrist camera's map at stride 16: where things are in the hand's frame
    object        touch embedding: which object is held
    centre        where on the fingertips the object is held
    held          whether the fingertips touch
    slip          how far the contact has moved on the fingertips since the grasp (`SlipMeter`)
    wrench        force on the arm, where it is recorded: the object pressed on the table
    force         grip force, from the depth of the gel, mean over the fingertips
    words         touch against a sentence: the normalised distance, clipped to [0, 1]
    value         1 - the progress that a `Value` predicts; it does not depend on the goal

`features.embedded` has the arrays that the distances are computed from.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Float16, Float32
from scipy.signal import lfilter

from touchgoal.rewards.curves import FUSED, UNITS_AT_HALF
from touchgoal.rewards.features.embedded import TOUCH, Features, cameras_of

Costs = dict[str, Float[np.ndarray, " n"]]

TOUCH_PARTS = ("object", "force", "centre", "held", "slip")
VALUE, WORDS, FORCE = "value", "words", "force"
VALUE_SHARE = 0.4
"""Share of the value in a fused cost; the rest is the root mean square of the parts. Chosen, like the
form of a part's cost, on objects that benchmark reward-quality does not judge on."""
SMALLEST_UNIT = {
    "front": 1e-3,
    "wrist": 1e-3,
    "wrist_map": 1e-2,
    "object": 1e-3,
    "force": 0.5,  # N, below which the depth of a gel reads noise
    "centre": 2e-4,  # m
    "slip": 2e-4,  # m
    "wrench": 1.0,  # N
    "held": 1 / 3,  # so that a missing fingertip costs 0.8
}
"""Least unit of each part, about the noise of a camera: some demonstrations end almost alike. Other
cameras have the one of `front`."""
SPREAD_QUANTILE = 0.9  # of distances between ends that all succeeded: their spread
_NO_CONTACT = 0.02  # m between two centres of which one is missing: about the width of a gel
_SOFTNESS = 8.0  # exponent of the soft minimum
_WRIST_MAP = "wrist_map"
_WORST = 0.1  # share of a map's positions: what lies elsewhere than at the goal covers few of them
_CHUNK = 64  # frames of maps in float64 at once
SMOOTHING = 0.1  # time constant of the causal smoothing, s


def part_distances(mine: Features, goal: Features) -> dict[str, Float[np.ndarray, "n g"]]:
    """Return the distance of each frame to each goal, for the parts that both have.

    Images: cosine distance, at stride 16 its mean over the worst tenth of the positions. Object: half
    the squared distance of embeddings. Force: N, of the mean over the fingertips. Centre: m. Held: 0 or 1.
    Slip: m, whatever the goal. These are means over the fingertips. Wrench: N.
    """
    distances = {}
    for name in cameras_of(goal):
        if name in mine:
            distances[name] = cosine_distances(mine[name], goal[name])
        if name == "wrist" and _WRIST_MAP in mine and _WRIST_MAP in goal:
            distances[_WRIST_MAP] = map_distances(mine[_WRIST_MAP], goal[_WRIST_MAP])
    if TOUCH in goal and "held" in goal and "held" in mine:
        distances["object"] = object_distances(mine[TOUCH], goal[TOUCH])
        apart = mine["held"][:, None] != goal["held"]
        distances["held"] = apart.any(-1).astype(np.float64)
        if "centre" in mine and "centre" in goal:
            away = np.linalg.norm(mine["centre"][:, None] - goal["centre"], axis=-1)
            distances["centre"] = np.where(apart, _NO_CONTACT, away).mean(-1).astype(np.float64)
        if "slip" in mine:
            slip = mine["slip"].astype(np.float64).mean(1)
            distances["slip"] = np.repeat(slip[:, None], len(goal["held"]), axis=1)
    if FORCE in goal and FORCE in mine:
        distances[FORCE] = force_distances(mine[FORCE], goal[FORCE])
    if "wrench" in goal and "wrench" in mine:
        force, wanted = (f["wrench"][:, :3].astype(np.float64) for f in (mine, goal))
        distances["wrench"] = np.linalg.norm(force[:, None] - wanted, axis=-1)
    return distances


def cosine_distances(
    mine: Float[np.ndarray, "n d"], goals: Float32[np.ndarray, "g d"]
) -> Float[np.ndarray, "n g"]:
    """Return 1 - the dot product of each with each goal: 1 - cos of unit vectors."""
    return 1 - mine.astype(np.float64) @ goals.astype(np.float64).T


def map_distances(
    mine: Float16[np.ndarray, "n c y x"], goals: Float16[np.ndarray, "g c y x"]
) -> Float[np.ndarray, "n g"]:
    """Return 1 - cos at the positions of two maps, mean over the worst tenth of the positions."""
    theirs = unit_map(goals).transpose(2, 1, 0)
    worst = max(1, round(_WORST * len(theirs)))
    chunks = []
    for i in range(0, len(mine), _CHUNK):
        apart = 1 - unit_map(mine[i : i + _CHUNK]).transpose(2, 0, 1) @ theirs
        chunks.append(np.partition(apart, -worst, axis=0)[-worst:].mean(0))
    return np.concatenate(chunks)


def object_distances(
    touch: Float32[np.ndarray, "n sides k"], goals: Float32[np.ndarray, "g sides k"]
) -> Float[np.ndarray, "n g"]:
    """Return half the squared distance of embeddings: 1 - cos for unit vectors, 0 for equal ones."""
    mine, theirs = (np.square(t, dtype=np.float64).sum(-1).mean(1) for t in (touch, goals))
    return (mine[:, None] + theirs) / 2 - 1 + touch_distances(touch, goals)


def touch_distances(
    touch: Float32[np.ndarray, "n sides k"], goals: Float32[np.ndarray, "g sides k"]
) -> Float[np.ndarray, "n g"]:
    """Return 1 - the dot product of each touch with each goal's same fingertip, mean over them."""
    return 1 - np.einsum("nsk,gsk->ng", touch, goals, dtype=np.float64) / touch.shape[1]


def force_distances(
    mine: Float32[np.ndarray, "n sides"], goals: Float32[np.ndarray, "g sides"]
) -> Float[np.ndarray, "n g"]:
    """Return the difference of the forces, mean over the fingertips, N."""
    return np.abs(mine.mean(1, np.float64)[:, None] - goals.mean(1, np.float64))


def soft_minimum(distances: Float[np.ndarray, "n g"]) -> Float[np.ndarray, " n"]:
    """Return the mean over the goals with weights d^-8: the nearest one counts most.

    Of one goal it is the distance itself.
    """
    positive = np.maximum(distances, 1e-12)  # rounding: -1e-7
    weights = (positive.min(1, keepdims=True) / positive) ** _SOFTNESS
    return (weights * distances).sum(1) / weights.sum(1)


def part_costs(mine: Features, goal: Features, units: Mapping[str, float]) -> Costs:
    """Return the cost of each part that has a unit, in [0, 1]; fingertip parts gated by contact."""
    own, costs = goal_spread(goal), {}
    for name, d in part_distances(mine, goal).items():
        if name in units:
            half = (UNITS_AT_HALF * max(units[name], own.get(name, 0.0))) ** 2
            square = soft_minimum(d) ** 2
            costs[name] = square / (square + half)
    if "held" not in mine:
        return costs
    touching = mine["held"].max(axis=1)
    # without contact it is 1, or 0 if the goal is without, too; a force is a touch
    free = float(goal["held"].any()) if "held" in goal else 1.0
    gated = {k: np.where(touching, c, free) for k, c in costs.items() if k in TOUCH_PARTS}
    return costs | gated


def goal_spread(goal: Features) -> dict[str, float]:
    """Return by part how far several goals are from each other, each measured to the others.

    Parts with a single goal are left out, and slip, which does not depend on the goal.
    """
    spread = {}
    for name, d in part_distances(goal, goal).items():
        if (n := len(d)) > 1 and name != "slip":
            others = d[~np.eye(n, dtype=bool)].reshape(n, n - 1)
            spread[name] = float(np.quantile(soft_minimum(others), SPREAD_QUANTILE))
    return spread


def smooth_and_fuse(
    parts: Mapping[str, Float[np.ndarray, " n"]], fps: float, before: Mapping[str, float] | None
) -> Costs:
    """Return the parts, smoothed exponentially, and "fused": their root mean square, and a share of the value.

    `before` has the costs of the previous frame, None at the beginning. Empty without parts.
    """
    keep, last = np.exp(-1 / (fps * SMOOTHING)), before or {}
    smoothed = {
        name: lfilter([1 - keep], [1, -keep], cost, zi=[keep * last.get(name, cost[0])])[0]
        for name, cost in parts.items()
    }
    equal = [cost for name, cost in smoothed.items() if name != VALUE]
    if not equal:
        return {}
    fused = np.sqrt(np.mean(np.square(equal), axis=0))
    if VALUE in smoothed:
        fused = VALUE_SHARE * smoothed[VALUE] + (1 - VALUE_SHARE) * fused
    return smoothed | {FUSED: fused}


def unit_map(maps: Float16[np.ndarray, "n c y x"]) -> Float[np.ndarray, "n c p"]:
    """Return maps with a unit vector at each position, the positions flattened."""
    whole = maps.astype(np.float64)  # float32 would make batch and stream differ by 1e-6
    whole /= np.maximum(np.linalg.norm(whole, axis=1, keepdims=True), 1e-6)
    return whole.reshape(*whole.shape[:2], -1)
