"""A policy on disk, for a cell's arm."""

from touchgoal.control.cell.config import CellConfig
from touchgoal.control.deployment.actors import CellPolicy
from touchgoal.policies.checkpoint import SHIPPED_POLICIES, SavedPolicy, find_policy
from touchgoal.sim_envs.config import TaskConfig


def load_saved_policy(cell: CellConfig, task: TaskConfig) -> CellPolicy:
    """Return the policy on disk that the cell names; UserError if it does not fit."""
    shipped = cell.task.policy == "shipped"
    directory = SHIPPED_POLICIES[cell.task.name] if shipped else find_policy(cell.task.policy)
    policy = SavedPolicy(directory)()
    return CellPolicy.fitting(cell, policy, policy.env_config(task))
