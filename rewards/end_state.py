"""How things rest at the end of an episode: the parts of a cost, each read in the phase where it counts.

What is held and how far it slipped mean something until it is put down: they are read at the last frame
before. Where things are, and whether they are held, is read at the end.
"""

from collections.abc import Mapping

import numpy as np

from touchgoal.rewards.distance.parts import VALUE, VALUE_SHARE, part_costs
from touchgoal.rewards.features.embedded import Features, split_features, take_rows
from touchgoal.rewards.value import Value

CARRIED = ("object", "slip")
"""Parts that are read before the object is put down."""
RESTING = ("wrist", "wrist_map", "worst", "held")
"""Parts that are read at the end."""
_DESCENT = 0.02  # m of the hand, the last ones of which may end with a put-down
_LEVEL_SECONDS = 0.4  # s of carrying before, whose median wrench is that of the carried object
_TABLE = 1.0  # N of change of the wrench by which the table takes the object


def put_down(history: Features, fps: float) -> int | None:
    """Return the row at which what is held meets the table; None if it was not carried, or is not known.

    It is the first change of the wrench by 1 N in the last 2 cm of the hand's last descent with it.
    """
    if any(name not in history for name in ("held", "wrench", "tcp_pose")):
        return None
    height = history["tcp_pose"][:, 2].astype(np.float64)
    held = history["held"].all(axis=1)
    if not held.any():
        return None
    highest = int(np.argmax(np.where(held, height, -np.inf)))
    lowest = highest + int(np.argmin(height[highest:]))
    lifted = height[highest] - height[int(np.argmax(held)) : highest + 1].min()
    if min(lifted, height[highest] - height[lowest]) < _DESCENT:
        return None
    near = np.flatnonzero(height[highest : lowest + 1] > height[lowest] + _DESCENT)
    begin = highest + int(near[-1])
    force = history["wrench"][:, :3].astype(np.float64)
    level = np.median(force[max(highest, begin - round(_LEVEL_SECONDS * fps)) : begin + 1], axis=0)
    changed = np.linalg.norm(force[begin:] - level, axis=1) > _TABLE
    return begin + int(np.argmax(changed)) if changed.any() else None


def end_costs(
    features: Features, fps: float, goal: Features, units: Mapping[str, float], value: Value | None
) -> dict[str, float]:
    """Return the cost of each part at the end of an episode, in [0, 1]; those that both sides have.

    Args:
        features: of all frames so far; of images the last frame is enough.
        fps: frames per second of the touch and of the arm.
        goal: ends of successes.
        units: see `DistanceNormalizer`.
        value: of the task, if there is one.
    """
    seen, felt = split_features(features)
    seen = take_rows(seen, slice(-1, None))
    end = {**seen, **take_rows(felt, slice(-1, None))}
    costs = {k: float(c[0]) for k, c in part_costs(end, goal, units).items() if k in RESTING}
    before = put_down(felt, fps)
    row = len(next(iter(felt.values()), ())) - 1 if before is None else max(before - 1, 0)
    carried = part_costs(take_rows(felt, slice(row, row + 1)), goal, units)
    costs |= {k: float(c[0]) for k, c in carried.items() if k in CARRIED}
    if value is not None:
        costs[VALUE] = 1 - float(value.progress(seen)[0])
    return costs


def end_cost(costs: Mapping[str, float]) -> float:
    """Return the cost of an end: a share of the value's, the rest the root mean square of the parts."""
    parts = [cost for name, cost in costs.items() if name != VALUE]
    fused = float(np.sqrt(np.mean(np.square(parts)))) if parts else costs[VALUE]
    if VALUE not in costs:
        return fused
    return VALUE_SHARE * costs[VALUE] + (1 - VALUE_SHARE) * fused
