"""Whether policies say when they are done: the simulator's verdict is hidden, a run ends when the policy says so.

Then it rests for a second, and the simulator tells the outcome. Also with the object taken away or knocked out of
the hand, where the policy must mend that, or at least not call it done.
"""

from dataclasses import asdict, replace
from typing import Any, get_args

from benchmarks.deployment.robustness import CHANGES
from benchmarks.deployment.trials import TABLE_HEAD, UNCHANGED, TrialOptions, deployed, table_row
from touchgoal.policies.evaluation.evaluate import FALSELY_DONE, evaluate
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
    lines, rows = [TABLE_HEAD], []
    count, seed, workers = config.episodes, config.seed, config.workers
    for what, env in (case for task in config.tasks for case in _cases(task)):
        result = evaluate(config.policy, env, episodes=count, seed=seed, workers=workers)
        late = [abs(t.late) for t in result.trials if t.success and t.late is not None]
        falsely = sum(t.failure == FALSELY_DONE for t in result.trials)
        unsaid = sum(t.success for t in result.trials) - len(late)
        soon = sum(seconds <= _SOON for seconds in late)
        said = f"; falsely done {falsely}, not said {unsaid}, within {_SOON:g} s {soon}/{len(late)}"
        lines.append(table_row(what, result) + said)
        rows.append({"what": what, "trials": [asdict(trial) for trial in result.trials]})
    return {"table": "\n".join(lines), "rows": rows}


def _cases(task: TaskName) -> list[tuple[str, TaskConfig]]:
    base = replace(deployed(task), ends_by_success=False)
    changes = {UNCHANGED: {}}
    changes |= {name: CHANGES[task][name] for name in _INTERFERENCES if task == "pick-place"}
    return [(f"{task}, {name}", replace(base, **change)) for name, change in changes.items()]
