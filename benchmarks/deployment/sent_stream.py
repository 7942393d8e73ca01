"""Commands to the arm against the workspace box and every limit, under wild policies."""

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from benchmarks.options import BenchmarkOptions
from touchgoal.control.motion.arm_models import JointLimits
from touchgoal.control.motion.tracker import Tracker
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.limits import FR3, UR5E, RobotLimits
from touchgoal.runtime.option_types import Positive, Seed, checked_dataclass
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.cell.deployed_arm import measurements_at_rest


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark sent-stream."""

    seconds: Positive = 3600.0
    """Simulated seconds of motion over both arms at 20, 50 and 125 Hz; an hour takes 8 minutes."""
    seed: Seed = 0
    """Random seed of the policy's actions."""


Joints = Float[np.ndarray, " n"]
Path = Float[np.ndarray, "t n"]

_DT = 1e-3  # s
_LATE = 0.3  # share of the commands that are late, by up to a tick
_PUSH_SECONDS = 1.25  # s for which a wild policy keeps its direction
_ROUNDING = 1e-12  # rad
_PIECE = 10.0  # s of motion that are judged together


def wild_commands(layer: ActionFilter, ticks: int, rng: np.random.Generator) -> list[Joints]:
    """Return the filtered joint targets (rad) of a policy that pushes anywhere, often very hard."""
    n = layer.joints.lower.size
    state, push, commands = layer.start(layer.limits.arm.home), np.zeros(n), []
    for tick in range(ticks):
        if tick % round(_PUSH_SECONDS / layer.dt) == 0:
            push = rng.choice([0.05, 1.0, 1e300]) * rng.standard_normal(n)
        state = layer.filter_action(state, push, measurements_at_rest(state.q))
        commands.append(state.q)
    return commands


def late_by(ticks: int, period: int, rng: np.random.Generator) -> Int[np.ndarray, " t"]:
    """Return the lateness of each command (ms): mostly none, sometimes up to a period."""
    return rng.integers(0, period, ticks) * (rng.random(ticks) < _LATE)


def send(
    robot: RobotLimits, hz: int, commands: Sequence[Joints], late: Sequence[int]
) -> Iterator[Joints]:
    """Return the tracker's 1 kHz set-points (rad) for commands with these delays."""
    tracker, period = Tracker(robot.interface, robot.policy.velocity, 1 / hz, _DT), 1000 // hz
    state = tracker.start(robot.arm.home)
    for command, delay in zip(commands, late, strict=True):
        for ms in range(period):
            if ms == delay:
                state = tracker.set_target(state, command)
            state = tracker.step(state)
            yield state.q


def outside_box(layer: ActionFilter, q: Path) -> float:
    """Return how far (m) flange or fingers leave their boxes at worst; negative inside."""
    points, limits = layer.monitored_points(q), layer.limits
    beyond = [
        np.maximum(box.lower - p, p - box.upper).max()
        for box, p in ((limits.flange, points[:, :1]), (limits.fingertips, points[:, 1:]))
    ]
    return float(max(beyond))


def shares_of_limits(limits: JointLimits, q: Path) -> tuple[float, float, float]:
    """Return the greatest speed, acceleration and jerk of a 1 kHz path over the limits."""
    allowed = (limits.velocity, limits.acceleration, limits.jerk)
    most = (np.abs(np.diff(q, k, axis=0)) / _DT**k for k in (1, 2, 3))
    speed, acceleration, jerk = (float((m / a).max()) for m, a in zip(most, allowed, strict=True))
    return speed, acceleration, jerk


def run(config: Config) -> dict[str, Any]:
    """Push both arms at three rates, with commands in time and late."""
    cases = list(product((FR3, UR5E), (20, 50, 125), (False, True)))
    seconds = config.seconds / len(cases)
    rows = [_row(*case, seconds, config.seed) for case in track(cases, "pushing", "case")]
    lines = [f"{'arm, rate, commands':<26}{'outside mm':>12}{'speed':>8}{'accel.':>8}{'jerk':>8}"]
    lines += [
        f"{row['what']:<26}{1e3 * row['outside']:>12.3f}{row['speed']:>8.3f}"
        f"{row['acceleration']:>8.3f}{row['jerk']:>8.3f}"
        for row in rows
    ]
    lines.append("speed, acceleration, jerk: greatest, as shares of the 1 kHz interface's limits")
    return {"rows": rows, "table": "\n".join(lines)}


def _row(robot: RobotLimits, hz: int, late: bool, seconds: float, seed: int) -> dict[str, Any]:
    layer, rng, limits = ActionFilter(robot, hz), np.random.default_rng(seed), robot.interface
    outside, shares = -np.inf, np.zeros(3)
    for _ in range(max(1, round(seconds / _PIECE))):
        ticks = round(_PIECE * hz)
        commands = wild_commands(layer, ticks, rng)
        delays = late_by(ticks, 1000 // hz, rng) if late else np.zeros(ticks, int)
        q = np.array(list(send(robot, hz, commands, delays.tolist())))
        low, high = limits.lower - _ROUNDING, limits.upper + _ROUNDING
        inside_range = (q >= low).all() and (q <= high).all()
        outside = max(outside, outside_box(layer, q[::5]) if inside_range else np.inf)
        shares = np.maximum(shares, shares_of_limits(limits, q))
    return {
        "what": f"{robot.arm.name}, {hz} Hz, {'some late' if late else 'in time'}",
        "outside": outside,
        "speed": shares[0],
        "acceleration": shares[1],
        "jerk": shares[2],
    }
