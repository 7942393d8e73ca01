"""Report of a finished deployment: the numbers of metrics.json, and the operator's lines."""

from typing import Any

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.deployment.control_loop import SLOW_ARM, slow_arm
from touchgoal.control.deployment.session import Result
from touchgoal.control.tactile.light_gain import LightWatch, light_advice

_LIGHT_TICKS = 10  # from one look at the fingertips' light to the next
_VERDICTS = {True: "done", False: "not done", None: "unknown whether it is done"}


def metrics(result: Result) -> dict[str, Any]:
    """Return the numbers of a run, for metrics.json."""
    ending, log = result.ending, result.log
    light = LightWatch()
    for row in log.rows[::_LIGHT_TICKS]:
        light.update(row)
    forces = [np.linalg.norm(row[ft.WRENCH][:3]) for row in log.rows]
    return {
        "reason": ending.reason,
        "stopped": ending.stopped,
        "advice": ending.advice,
        "rest_seconds": ending.rest_seconds,
        "success": result.success,
        "progress": result.progress,
        "held_width": result.held_width,
        "episode": result.episode,
        "recording_error": result.recording_error,
        "ticks": len(log.rows),
        "late_p99_ms": 1e3 * float(np.percentile(log.lateness or [0.0], 99)),
        "answered_p95_ms": 1e3 * float(np.percentile(log.answer_times or [0.0], 95)),
        "force_max_newtons": float(max(forces, default=0.0)),
        "clamped": log.limit_counts,
        "arm_pace": log.arm_pace,
        "light_change": light.change,
    }


def report(result: Result, numbers: dict[str, Any], episodes: str) -> str:
    """Return the lines for the operator; `episodes` is the folder recorded into."""
    ending, log = result.ending, result.log
    clamped = ", ".join(f"{name} {n}" for name, n in log.limit_counts.items()) or "never"
    lines = [
        f"{len(log.rows)} ticks of the control loop; 99 % began at most {numbers['late_p99_ms']:.1f} ms "
        f"late, 95 % were answered within {numbers['answered_p95_ms']:.1f} ms",
        f"largest force on the hand: {numbers['force_max_newtons']:.1f} N; commands limited: {clamped}",
    ]
    if log.arm_pace < SLOW_ARM:
        lines.append(slow_arm(log.arm_pace))
    if advice := light_advice([numbers["light_change"]]):
        lines.append(advice)
    if result.held_width is not None:
        lines.append(f"the hand still holds something, {1e3 * result.held_width:.0f} mm wide")
    if result.episode is not None:
        lines.append(
            f"episode {result.episode} is in {episodes}; its curves: touchgoal reward-curves {episodes}"
        )
    lines.append(str(ending) if ending.stopped else f"ended: {ending}")
    if not ending.stopped and (result.episode is not None or result.success is not None):
        lines.append(f"task: {_VERDICTS[result.success]}")
    return "\n".join(lines)
