"""Success and force under changes that training has not shown, one at a time.

To see whether a change is hard for any controller, run the expert or the classical follower under
it: `--policy expert`, `--policy follower`.
"""

from dataclasses import replace
from typing import Any, get_args

from benchmarks.deployment.first_look import changed_camera
from benchmarks.deployment.trials import UNCHANGED, TrialOptions, deployed, try_cases
from touchgoal.control.cell.config import SimulatedTask
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import checked_dataclass
from touchgoal.sim_envs.config import TaskConfig, TaskName
from touchgoal.sim_envs.scene.lighting import Lighting
from touchgoal.sim_envs.scene.objects import NEW_KINDS
from touchgoal.sim_envs.scene.wires import HELD_OUT

_LIGHT = {
    f"light {change:+.0%}": {"light_change": (change,)} for change in (-0.15, -0.05, 0.1, -0.8)
}
_DELAYED = {  # state and images; at 20 Hz a tick is 50 ms; learned policies go slower
    f"{ticks} ticks late": {"state_delay": (s, s), "image_delay": (s, s)}
    for ticks, s in ((2, 0.1), (4, 0.2))
}
_LONGER = 1.5  # factor on the time limit of an episode with late or frozen observations
_SOON = 2.0  # s
_FROZEN = {"every second picture frozen": {"image_rate": 10.0}}
_CHANGES: dict[TaskName, dict[str, dict[str, Any]]] = {
    "pick-place": {
        **_LIGHT,
        "1 other object, target named": {"distractors": 1},
        "2 other objects, target named": {"distractors": 2},
        "kinds never trained on": {"objects": tuple(NEW_KINDS)},
        "mass x2": {"mass": (0.04, 0.4)},
        "size x1.2": {"size_factor": 1.2},
        "friction x0.5": {"friction_factor": 0.5},
        "object moved 2 cm after a second": {"nudge": 0.02},
        "object taken away": {"interference": "taken", "max_seconds": 24.0},
        "object knocked out of the hand": {"interference": "knocked", "max_seconds": 24.0},
        "camera turned 5 degrees up": changed_camera(turn=(0, 5, 0)),
        "camera turned 5 degrees aside": changed_camera(turn=(0, 0, 5)),
        "camera moved 2 cm aside": changed_camera((0, 0.02, 0)),
        "lamp moved 40 cm": {"lighting": Lighting(lamp_shift=(-0.4, 0.0, 0.0))},
        "room light -80%": {"lighting": Lighting(room_light=-0.8)},
    },
    "bead-maze": {
        **_LIGHT,
        "grip x0.5": {"grasp_force": (4.0, 6.0)},
        "grip x1.5": {"grasp_force": (12.0, 18.0)},
        "up to 30 degrees askew": {"start_angle": 30.0},
        "friction x0.5": {"wire_friction": (0.075, 0.125)},
        "friction x2": {"wire_friction": (0.3, 0.5)},
        "a family of wires never trained on": {"families": (HELD_OUT,)},
    },
}


@checked_dataclass
class Config(TrialOptions):
    """Options of benchmark robustness."""

    tasks: tuple[TaskName, ...] = get_args(SimulatedTask)
    """Tasks; the maze is on test wires."""
    changes: tuple[str, ...] = ()
    """Changes to try, such as "light -15%"; default: all of the task, and none."""
    hidden_verdict: bool = False
    """Hide the simulator's verdict: a run ends when the policy says that it is done. Then the arm rests for
    a second, and the simulator tells the outcome."""


def run(config: Config) -> dict[str, Any]:
    """Return success by task and change, with the trials."""
    cases = [
        (f"{task}, {name}", env)
        for task in config.tasks
        for name, env in _environments(config, task).items()
        if not config.changes or name in config.changes
    ]
    if not cases:
        known = sorted({name for task in config.tasks for name in _environments(config, task)})
        raise UserError(f"no such change; choose from: {', '.join(known)}")
    found = try_cases(config, cases)
    lines = [found["table"]]
    for row in found["rows"] if config.hidden_verdict else ():
        late = [t["late"] for t in row["trials"] if t["success"]]
        soon = sum(seconds is not None and abs(seconds) <= _SOON for seconds in late)
        lines.append(f"{row['what']}: {soon} of {len(late)} successes ended within {_SOON:g} s")
    return {**found, "table": "\n".join(lines)}


def _environments(config: Config, task: TaskName) -> dict[str, TaskConfig]:
    base = replace(deployed(task), ends_by_success=not config.hidden_verdict)
    delays, longer = _DELAYED | _FROZEN if base.as_deployed else {}, _LONGER * base.max_seconds
    late = {
        name: replace(base, deployment=replace(base.deployment, **change), max_seconds=longer)
        for name, change in delays.items()
    }
    changed = {name: replace(base, **change) for name, change in _CHANGES.get(task, {}).items()}
    return {UNCHANGED: base, **changed, **late}
