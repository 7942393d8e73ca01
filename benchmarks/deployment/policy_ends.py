"""Whether policies say when they are done: the simulator's verdict is hidden, a run ends when the policy says so.

Then it rests for a second, and the simulator tells the outcome. Also with the object taken away or knocked out of
the hand, where the policy must mend that, or at least not call it done.
"""

from dataclasses import replace
from typing import Any, get_args

from benchmarks.deployment.robustness import CHANGES
from benchmarks.deployment.trials import UNCHANGED, TrialOptions, deployed, try_cases
from touchgoal.runtime.option_types import checked_dataclass
from touchgoal.sim_envs.config import TaskConfig, TaskName

_INTERFERENCES = "object taken away", "object knocked out of the hand"
_SOON = 2.0  # s


@checked_dataclass
class Config(TrialOptions):
    """Options of benchmark policy-ends."""

    tasks: tuple[TaskName, ...] = get_args(TaskName)
    """Tasks, as deployed; the maze is on test wires."""


def run(config: Config) -> dict[str, Any]:
    """Return success and ends of every task, with the trials."""
    found = try_cases(config, (case for task in config.tasks for case in _cases(task)))
    lines = [found["table"]]
    for row in found["rows"]:
        late = [t["late"] for t in row["trials"] if t["success"]]
        soon = sum(seconds is not None and abs(seconds) <= _SOON for seconds in late)
        lines.append(f"{row['what']}: {soon} of {len(late)} successes ended within {_SOON:g} s")
    return {**found, "table": "\n".join(lines)}


def _cases(task: TaskName) -> list[tuple[str, TaskConfig]]:
    base = replace(deployed(task), ends_by_success=False)
    changes = {UNCHANGED: {}}
    changes |= {name: CHANGES[task][name] for name in _INTERFERENCES if task == "pick-place"}
    return [(f"{task}, {name}", replace(base, **change)) for name, change in changes.items()]
