"""How things rest at the end of an episode: the parts of a cost, each read in the phase where it counts.

What is held and how far it slipped mean something until it is put down: they are read at the last frame
before. Where things are, whether they are held, whether they were put down, and how hard the arm presses
are read at the end. Beside a wrist camera the others are left to the value: where things go varies.

    value         1 - the progress that a `Value` sees
    scene         the wrist camera's map, each cell against the same cell of the likest success, whatever its
                  object: the cells that no success resembles (as PatchCore does, arXiv 2106.08265)
    put_down      whether something was put down, if successes put something down
    press         how much harder the arm presses than successes do; 5 N are always allowed

The others are parts of `distance.parts`. Value and scene, which tell places, have two fifths of the cost.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float16

from touchgoal.rewards.curves import UNITS_AT_HALF
from touchgoal.rewards.distance.parts import (
    SPREAD_QUANTILE,
    VALUE,
    Costs,
    part_costs,
    unit_map,
)
from touchgoal.rewards.features.embedded import (
    CARRIED,
    PUT_DOWN,
    SCENE_MAP,
    Features,
    cameras_of,
    split_features,
    take_rows,
)
from touchgoal.rewards.value import Value

_CARRIED = ("object", "slip")
"""Parts that are read before the object is put down."""
RESTING = ("wrist", "held")
"""Parts that are read at the end, beside those above."""
PLACE, _PLACE_SHARE = (VALUE, "scene"), 0.4
_WORST, _SCENE_UNIT = 0.05, 0.36  # share of the cells; their distance between successes (90 %)
_DESCENT = 0.02  # m of the hand, the last ones of which may end with a put-down
_LEVEL_SECONDS = 0.4  # s of carrying before, whose median wrench is that of the carried object
_REST = 0.5  # s at the end over which the arm's force is taken
_SOFT = 5.0  # N: pressing less costs nothing
_FIRMER = 0.7  # log of the force's ratio that counts as a spread of successes
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


def carried_row(history: Features, before: int | None) -> int:
    """Return the last row before the put-down, given its row; without one, the last in which something is held.

    Where nothing ever is, it is the last row of all.
    """
    if before is not None:
        return max(before - 1, 0)
    held = np.flatnonzero(history.get("held", np.zeros((0, 1), bool)).all(axis=1))
    return int(held[-1]) if len(held) else len(next(iter(history.values()), ())) - 1


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
    seen, rest = take_rows(seen, slice(-1, None)), take_rows(felt, slice(-1, None))
    before = put_down(felt, fps)
    lets_go = any(stored in goal for stored in CARRIED.values())
    carried = rest
    if before is not None or lets_go:
        at = carried_row(felt, before)
        carried = take_rows(felt, slice(at, at + 1))
    resting = RESTING if "wrist" in goal else (*cameras_of(goal), *RESTING)
    costs = _some(part_costs({**seen, **rest}, goal, units), resting)
    costs |= _some(_carried_costs(carried, goal, units), _CARRIED)
    if value is not None:
        costs[VALUE] = 1 - float(value.progress(seen)[0])
    if "wrist_map" in goal and "wrist_map" in seen:
        costs["scene"] = _scene(seen["wrist_map"], goal.get(SCENE_MAP, goal["wrist_map"]))
    if PUT_DOWN in goal and goal[PUT_DOWN].mean() > 0.5:
        costs[PUT_DOWN] = float(before is None)
    if "wrench" in goal and "wrench" in felt:
        costs["press"] = _press(felt, fps, goal)
    return costs


def end_cost(costs: Mapping[str, float]) -> float:
    """Return the cost of an end: the root mean square of its parts, in which those of place weigh more."""
    groups = [[c**2 for n, c in costs.items() if (n in PLACE) == place] for place in (True, False)]
    if not all(groups):
        return float(np.sqrt(np.mean(np.concatenate(groups))))
    place, other = map(np.mean, groups)
    return float(np.sqrt(_PLACE_SHARE * place + (1 - _PLACE_SHARE) * other))


def _carried_costs(carried: Features, goal: Features, units: Mapping[str, float]) -> Costs:
    """Return the costs against what successes carried, if their hands are empty at the end."""
    held = {name: goal[stored] for name, stored in CARRIED.items() if stored in goal}
    if "slip" in held and "slip" in units:
        slip = float(np.quantile(held["slip"].mean(1), SPREAD_QUANTILE))
        units = {**units, "slip": max(units["slip"], slip)}
    return part_costs(carried, {**goal, **held}, units)


def _some(costs: Mapping[str, np.ndarray], names: tuple[str, ...]) -> dict[str, float]:
    return {name: float(costs[name][0]) for name in names if name in costs}


def _scene(seen: Float16[np.ndarray, "1 c y x"], known: Float16[np.ndarray, "g c y x"]) -> float:
    """Return the cost of the cells of a map that are least like the same cell of any success."""
    mine, theirs = unit_map(seen)[0], unit_map(known)
    nearest = 1 - np.einsum("cp,gcp->gp", mine, theirs, optimize=True).max(0)
    worst = np.sort(nearest)[-max(1, round(_WORST * len(nearest))) :].mean()
    return _cost(worst / _SCENE_UNIT)


def _press(felt: Features, fps: float, goal: Features) -> float:
    """Return what it costs that the arm presses harder at the end than successes do."""
    forces = [np.linalg.norm(f["wrench"][:, :3], axis=1).astype(float) for f in (felt, goal)]
    now, usual = np.median(forces[0][-max(1, round(_REST * fps)) :]), max(_SOFT, forces[1].max())
    return _cost(max(0.0, float(np.log((1 + now) / (1 + usual)))) / _FIRMER)


def _cost(units: float) -> float:
    """Return the cost of a distance in units, as the parts have it."""
    return units**2 / (units**2 + UNITS_AT_HALF**2)
