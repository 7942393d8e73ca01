"""The on-line cost that a cell file's `task.rewards` asks for."""

from touchgoal.control.cell.config import CellConfig
from touchgoal.control.features import FRONT, IMAGE_PREFIX, TACTILE
from touchgoal.rewards.goals import Inputs, parse_goal
from touchgoal.rewards.normalizer import REAL_SCENE
from touchgoal.rewards.online import CostMeter, OnlineCost
from touchgoal.rewards.reward_model import load_reward_model


def load_cell_cost(cell: CellConfig) -> OnlineCost:
    """Return the distance to the cell's goals, measured in a thread; `close` ends it.

    UserError: a goal, encoder or normalizer that does not fit the cell.
    """
    simulated = cell.arm == "sim" or bool(cell.task.twin)
    inputs = Inputs(
        name="the cell",
        camera=FRONT if FRONT.removeprefix(IMAGE_PREFIX) in cell.cameras else None,
        sides=TACTILE if cell.fingertips is not None else (),
        sensor=cell.sensor,
        scene=f"simulated {cell.task.name}" if simulated else REAL_SCENE,
    )
    goals = [parse_goal(text) for text in cell.task.rewards]
    task = cell.task
    model = load_reward_model(
        inputs, goals, task.encoder or None, normalizer=task.normalizer or None
    )
    return OnlineCost(CostMeter(model))
