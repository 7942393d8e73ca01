"""Meaning of a set's actions, found by comparing them with the states that follow."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from touchgoal.control import features as ft
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError

ActionMeaning = Literal["change", "absolute", "relative"]
"""Joint change of each tick, joint positions, or joint change since the episode's start; rad."""
_WINDOW = 10  # ticks over which joint changes are added up, so that the arm's lag counts little
_CLEARLY = 3.0  # times better that another meaning must fit
_MAX_SPEED = 10.0  # rad/s; no joint of an arm that is read turns half as fast
_MAX_WIDTH = 0.2  # m of a gripper
_NAMES = {
    "change": "joint change per tick",
    "absolute": "absolute joint positions",
    "relative": "joint change since the episode's start",
}
_OTHERS = {
    "absolute joint positions in degrees": "store radians",
    "joint change per tick in degrees": "store radians",
    "joint velocities": "store the joint change per tick",
}


def joint_changes(
    action: Float[np.ndarray, "t 8"], state: Float[np.ndarray, "t 15"], meaning: ActionMeaning
) -> Float[np.ndarray, "t 8"]:
    """Return actions of an episode as `features.ACTION`: joint change per tick (rad), width (m)."""
    if meaning == "change":
        return action
    first = state[:1, : ft.N_JOINTS] * (meaning == "absolute")
    changes = np.diff(action[:, : ft.N_JOINTS], axis=0, prepend=first)
    return np.concatenate([changes, action[:, ft.N_JOINTS :]], 1)


def check_actions(episodes: EpisodeSet, rows: Sequence[int], meaning: ActionMeaning) -> str:
    """Return a line that says what the actions are.

    UserError, naming what they are: they have another meaning or unit, or the state has.
    """
    errors: dict[str, list[float]] = {}
    fastest, low, high = 0.0, np.inf, -np.inf
    for i in rows:
        frames = episodes.read(i, [ft.STATE, ft.ACTION]).frames
        q, action = frames[ft.STATE][:, : ft.N_JOINTS], frames[ft.ACTION]
        if np.abs(q).max() > 2 * np.pi:
            raise UserError(f"{episodes.root}: {ft.STATE} holds joints in degrees: store radians")
        a = action[:, : ft.N_JOINTS]
        fastest = max(fastest, float(np.quantile(np.abs(a), 0.99)) * episodes.fps)
        widths = np.concatenate([frames[ft.STATE][:, -1], action[:, -1]])
        low, high = min(low, float(widths.min())), max(high, float(widths.max()))
        for name, error in _errors(q, a, episodes.fps).items():
            errors.setdefault(name, []).append(error)
    if high > _MAX_WIDTH or low < -0.01:
        raise UserError(
            f"{episodes.root}: the gripper goes from {low:.2g} to {high:.2g}, which is no width "
            f"in metres: multiply {ft.ACTION} and {ft.STATE} by its stroke"
        )
    fit = {name: float(np.mean(values)) for name, values in errors.items()}
    given, possible = _NAMES[meaning], meaning != "change" or fastest < _MAX_SPEED
    known = [name for name in fit if name in _NAMES.values() or not possible]
    best = min(known, key=lambda name: fit[name], default=given)
    if best and best != given and _CLEARLY * fit[best] < fit[given]:
        option = next((m for m, name in _NAMES.items() if name == best), "")
        remedy = f"pass --actions {option}" if option != "change" else "leave out --actions"
        raise UserError(f"{episodes.root}: its actions are {best}: {_OTHERS.get(best, remedy)}")
    if not possible:
        raise UserError(
            f"{episodes.root}: its actions are no {given} (joints would turn at {fastest:.0f} "
            "rad/s), nor joint positions or velocities: store the joint change per tick, rad"
        )
    return f"actions: {given}, gripper in m"


def _errors(
    q: Float[np.ndarray, "t 7"], action: Float[np.ndarray, "t 7"], fps: int
) -> dict[str, float]:
    """Return by how much (rad) the joints differ from the actions' prediction under each meaning."""
    window = min(_WINDOW, len(q) - 1)
    if window < 1:
        return {}
    start, last, after = q[:-window], action[window - 1 : -1], q[window:]
    done = np.cumsum(action, 0, np.float64) - action  # before each tick
    total = done[window:] - done[:-window]
    predicted = {
        _NAMES["change"]: start + total,
        _NAMES["absolute"]: last,
        _NAMES["relative"]: q[0] + last,
        "": start,  # none of them: the actions explain no motion
        "absolute joint positions in degrees": np.deg2rad(last),
        "joint change per tick in degrees": start + np.deg2rad(total),
        "joint velocities": start + total / fps,
    }
    return {name: float(np.abs(value - after).mean()) for name, value in predicted.items()}
