"""Plans of the scripted demonstrator of pick-place: success, and every other outcome as its change."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from jaxtyping import Float

from touchgoal.sim_envs.cell.hardware import GRIPPER_MAX_WIDTH
from touchgoal.sim_envs.config import Outcome
from touchgoal.sim_envs.pick_place import PickPlace

CLEARANCE = 0.12  # m above the object before and after the grasp
LOWEST_GRASP = 0.0185  # m: the sensor case (32.5 mm) must stay above the table
LOWEST_PLACE = 0.0172
TOUCHDOWN_DEPTH = 0.010  # m below the grasp's height to look for the table when placing
SLIDE = 0.002  # m that a slipping object slides down in the hand before the hand holds it again
LONGEST_PLAN = 16.0  # s that a slow or repeated grasp may take

_OFF = (0.025, 0.030)  # m beside the goal; success allows 0.02
_SHORT = 0.04  # m before the goal, and above the table, where the hand lets go too early
_PRESSED = 0.012  # m that the hand goes on down after the object has met the table
_OVERGRIP = 40.0  # N, the most that the simulated gripper can press
_LOOSE = 0.85  # of the force that just holds the object
_GRAVITY = 9.81  # m/s^2
_HELD_AT_EDGE = 0.004  # m of a box that is left beyond the middle of the fingers
_HELD_OFF_CENTRE = 0.4  # of the radius of round objects; beyond 0.5 friction 0.6 does not hold them


@dataclass(frozen=True)
class Waypoint:
    """Target of a straight minimum-jerk move, fingers down, with the gripper at `width`."""

    name: str
    position: Float[np.ndarray, "3"] | None  # TCP position at the end, m, base frame; None: stay
    width: float  # gripper target throughout, m
    seconds: float  # duration
    # What ends the move before it arrives: the table carries the object, or it slid by `SLIDE`.
    until: Literal["arrived", "supported", "slid"] = "arrived"
    share: float = 1.0  # share of the duration after which the hand stops
    force: float | None = None  # N of each finger from here on; None: as before


Plan = list[Waypoint]


def picked_body(outcome: Outcome) -> str:
    """Return the name of the body that the hand takes."""
    return "distractor_1" if outcome == "wrong_object" else "object"


def _pick_and_place(
    env: PickPlace,
    body: str = "object",
    grasp_shift: Sequence[float] = (0, 0, 0),
    place_shift: Sequence[float] = (0, 0, 0),
    closed: float = 0.0,
) -> Plan:
    """Return the plan of a success; shifts (m) move the TCP at the grasp and at the goal."""
    pick = env.object_pose(body)[:3]
    pick[2] = max(pick[2], LOWEST_GRASP)
    pick += grasp_shift
    place = np.array([*env.goal, pick[2]]) + place_shift
    above, over = pick + [0, 0, CLEARANCE], place + [0, 0, CLEARANCE]
    deepest = np.array([*place[:2], max(place[2] - TOUCHDOWN_DEPTH, LOWEST_PLACE)])
    plan = [
        Waypoint("approach", above, GRIPPER_MAX_WIDTH, 1.0),
        Waypoint("descend", pick, GRIPPER_MAX_WIDTH, 0.7),
        Waypoint("close", None, closed, 0.8),
        Waypoint("lift", above, closed, 0.7),
        Waypoint("carry", 0.5 * (above + over), closed, 0.6),
        Waypoint("arrive", over, closed, 0.6),
        Waypoint("lower", place + [0, 0, 0.004], closed, 0.9, until="supported"),
        Waypoint("touch down", deepest, closed, 0.8, until="supported"),
        Waypoint("hold", None, closed, 0.8),
    ]
    if env.config.release:
        plan[-1:] = [
            Waypoint("release", None, GRIPPER_MAX_WIDTH, 0.5),
            Waypoint("retreat", over, GRIPPER_MAX_WIDTH, 0.8),
        ]
    return plan


def _drop(env: PickPlace) -> Plan:
    plan = _pick_and_place(env)
    opened = [replace(waypoint, width=GRIPPER_MAX_WIDTH) for waypoint in _from(plan, "arrive")]
    return _before(plan, "arrive") + opened


def _freeze(env: PickPlace, first: str, end: str) -> Plan:
    """Return a plan that stops at a random time between the beginnings of two waypoints."""
    plan = _pick_and_place(env)
    begun, moves = _before(plan, first), _before(_from(plan, first), end)
    ends = np.cumsum([move.seconds for move in moves])
    time = env.np_random.uniform(0.3 * moves[0].seconds, ends[-1])
    k = int(np.searchsorted(ends, time))
    share = 1 - (ends[k] - time) / moves[k].seconds
    return [*begun, *moves[:k], replace(moves[k], share=float(share))]


def _off(env: PickPlace) -> Plan:
    angle, distance = env.np_random.uniform(0, 2 * np.pi), env.np_random.uniform(*_OFF)
    shift = distance * np.array([np.cos(angle), np.sin(angle), 0])
    return _pick_and_place(env, place_shift=shift.tolist())


def _released_early(env: PickPlace) -> Plan:
    way = env.object_pose()[:2] - env.goal
    short = np.append(_SHORT * way / np.linalg.norm(way), _SHORT)
    plan = _before(_pick_and_place(env, place_shift=short.tolist()), "touch down")
    return [*plan, Waypoint("let go", None, GRIPPER_MAX_WIDTH, 0.5)]


def _edge_grasp(env: PickPlace) -> Plan:
    body, yaw = env.bodies[0], env.grasp_yaw()
    if body.kind.shape == "box":
        beside = max(body.size[:2]) - _HELD_AT_EDGE
    elif body.kind.shape == "capsule":
        beside = body.size[1]  # where the cap begins
    else:
        beside = _HELD_OFF_CENTRE * body.size[0]
    shift = [beside * np.cos(yaw), beside * np.sin(yaw), 0.0]
    return _pick_and_place(env, grasp_shift=shift, place_shift=shift)


def _pressed(env: PickPlace) -> Plan:
    plan = _pick_and_place(env)
    lower = _from(plan, "lower")[0]
    assert lower.position is not None
    press = Waypoint("press", lower.position - [0, 0, _PRESSED], lower.width, 0.4)
    return [*_before(plan, "touch down"), press, *_from(plan, "hold")]


def _slip(env: PickPlace) -> Plan:
    plan, firm = _pick_and_place(env), env.grasp_force
    body = env.bodies[0]
    holds = body.mass * _GRAVITY / (2 * body.kind.material.friction)
    loosen = Waypoint("loosen", None, 0.0, 2.0, until="slid", force=_LOOSE * holds)
    # The object hangs lower now: slow enough to stop as it meets the table, within a tick.
    rest = [replace(w, force=firm, seconds=2 * w.seconds) for w in _from(plan, "arrive")]
    # From a firm grip straight to a loose one the gels would spring back and throw the object.
    relax = replace(loosen, name="relax", until="arrived", seconds=0.3, force=min(firm, 4 * holds))
    return [*_before(plan, "arrive"), relax, loosen, *rest]


def _regrasped(env: PickPlace) -> Plan:
    plan = _pick_and_place(env)
    descend, close = plan[1:3]
    assert descend.position is not None
    up = descend.position + [0, 0, 0.04]
    return [
        *_before(plan, "lift"),
        Waypoint("lift a little", up, close.width, 0.5),
        Waypoint("put down", descend.position, close.width, 0.6, until="supported"),
        Waypoint("let go", None, GRIPPER_MAX_WIDTH, 0.5),
        Waypoint("rise", up, GRIPPER_MAX_WIDTH, 0.5),
        replace(descend, name="descend again"),
        *_from(plan, "close"),
    ]


PLANS: dict[Outcome, Callable[[PickPlace], Plan]] = {
    "success": _pick_and_place,
    "slow": lambda env: [replace(w, seconds=2 * w.seconds) for w in _pick_and_place(env)],
    "regrasped": _regrasped,
    # Closed on air the pads would touch each other, which would count as touch.
    "never_touch": partial(_pick_and_place, grasp_shift=(0, 0, 0.08), closed=0.03),
    "never_lifted": lambda env: _before(_pick_and_place(env), "lift"),
    "freeze": partial(_freeze, first="approach", end="close"),
    "freeze_holding": partial(_freeze, first="carry", end="lower"),
    "drop": _drop,
    "released_early": _released_early,
    "off": _off,
    "slip": _slip,
    "edge_grasp": _edge_grasp,
    "pressed": _pressed,
    "overgripped": lambda env: [replace(w, force=_OVERGRIP) for w in _pick_and_place(env)],
    "wrong_object": partial(_pick_and_place, body=picked_body("wrong_object")),
    "same_shape": _pick_and_place,  # the scene holds another object than the one asked for
}
"""By outcome: the function that plans it, from ground truth after a reset."""


def _before(plan: Plan, name: str) -> Plan:
    """Return the waypoints before the first one of that name."""
    return plan[: [waypoint.name for waypoint in plan].index(name)]


def _from(plan: Plan, name: str) -> Plan:
    """Return the waypoints from the first one of that name on."""
    return plan[len(_before(plan, name)) :]
