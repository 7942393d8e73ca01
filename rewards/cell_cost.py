"""The online cost that a cell file's `task.rewards` asks for."""

from pathlib import Path

from touchgoal.control.cell.config import CellConfig
from touchgoal.encoders import pretrained
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.rewards.embedding_distance import check_words
from touchgoal.rewards.goals import parse_goal
from touchgoal.rewards.normalizer import NORMALIZER, DistanceNormalizer
from touchgoal.rewards.online import CostMeter, OnlineCost
from touchgoal.rewards.setup import own_towers


def load_cell_cost(cell: CellConfig) -> OnlineCost:
    """Return the distance to the cell's goals, measured in a thread."""
    goals = [parse_goal(text) for text in cell.task.rewards]
    chosen = cell.task.encoder or pretrained.shipped_encoder_for(cell.sensor)
    encoder = pretrained.load_encoder(chosen, cell.sensor)
    check_words(goals, encoder)
    simulated = cell.arm == "sim" or bool(cell.task.twin)
    path = Path(cell.task.normalizer)
    if not cell.task.normalizer and simulated:
        path = pretrained.find_encoder(chosen) / NORMALIZER
    normalizer = DistanceNormalizer.load(path) if path.is_file() or cell.task.normalizer else None
    return OnlineCost(CostMeter(load_towers(own_towers(encoder)), encoder, normalizer, goals))
