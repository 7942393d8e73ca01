"""Tactile cost of real grasps: when it falls after first force; whether it separates objects."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from touchgoal.encoders.probes.property_probe import interval

_UNTOUCHED = 5  # frames
_LASTING = 3  # frames that a fall must last
_FALLEN = 0.05  # of the whole fall
_NEAR = 3  # frames


@dataclass(frozen=True, eq=False)
class EmbeddedGrasp:
    """One grasp with one encoder's embeddings."""

    trial: str
    object: str
    embeddings: Float[np.ndarray, "n d"]
    firmest: int  # frame of the largest force
    begins: int | None  # first with 0.5 N on the load cell; None if the hand was not open before

    @property
    def goal(self) -> Float[np.ndarray, " d"]:
        """Embedding at the largest force."""
        return self.embeddings[self.firmest]


def cost(
    embeddings: Float[np.ndarray, "*n d"], goal: Float[np.ndarray, " d"]
) -> Float[np.ndarray, "*n"]:
    """Return the cost to a goal: 1 untouched, 0 at the goal."""
    return 1 - embeddings @ goal / max(float(goal @ goal), 1e-12)


def judge_cost(grasps: list[EmbeddedGrasp]) -> dict[str, Any]:
    """Judge costs to another grasp of the same object and to other objects' grasps."""
    delays = [
        delay
        for grasp in grasps
        for other in grasps
        if other.object == grasp.object and other is not grasp and grasp.begins is not None
        if (delay := _delay(grasp, other.goal)) is not None
    ]
    firm = np.stack([grasp.goal for grasp in grasps])
    objects = np.array([grasp.object for grasp in grasps])
    costs = np.stack([cost(firm, goal) for goal in firm], 1)
    pairs = _aucs(costs, objects)
    by_goal = {name: float(np.mean(list(row.values()))) for name, row in pairs.items()}
    values, names = np.array(list(by_goal.values())), np.array(list(by_goal))
    return {
        "delays": delays,
        "near": float(np.mean(np.abs(delays) <= _NEAR)) if delays else float("nan"),
        "auc": float(values.mean()),
        "auc_interval": interval(values, names),
        "auc_of_pairs": pairs,
    }


def cost_table(result: dict[str, Any], encoder: str) -> str:
    """Return the result as printed text."""
    names = list(result["auc_of_pairs"])
    low, high = result["auc_interval"]
    delays = result["delays"]
    lines = [f"tactile cost by {encoder}, to the firmest frame of another grasp:"]
    if delays:
        lines.append(
            f"falls {min(delays)} to {max(delays)} frames (median {np.median(delays):g}) after 0.5 N on the "
            f"load cell, within {_NEAR} frames in {100 * result['near']:.0f} % of {len(delays)} pairs of grasps"
        )
    lines += [
        f"separates other objects: area under ROC {result['auc']:.2f} ({low:.2f}-{high:.2f}); by goal (row) and object:",
        " " * 27 + "".join(f"{name[:11]:>13}" for name in names),
    ]
    for name in names:
        row = result["auc_of_pairs"][name]
        cells = "".join(f"{row[n]:>13.2f}" if n in row else f"{'-':>13}" for n in names)
        lines.append(f"{name[:26]:<27}{cells}")
    return "\n".join(lines)


def _delay(grasp: EmbeddedGrasp, goal: np.ndarray) -> int | None:
    """Return frames from 0.5 N to a lasting fall of the cost; None if it never falls."""
    assert grasp.begins is not None
    costs = cost(grasp.embeddings, goal)
    open_hand = costs[: min(_UNTOUCHED, max(grasp.begins, 1))]
    start = float(np.median(open_hand))
    down = np.asarray(costs < start - _FALLEN * (start - costs.min()))
    at = _first_lasting(down)
    return None if at is None else at - grasp.begins


def _first_lasting(down: Bool[np.ndarray, " n"]) -> int | None:
    lasting = np.convolve(down, np.ones(_LASTING), "valid") == _LASTING
    return int(lasting.argmax()) if lasting.any() else None


def _aucs(costs: np.ndarray, objects: np.ndarray) -> dict[str, dict[str, float]]:
    """Return, for each pair of objects, how often the other object's grasp has the higher cost."""
    table: dict[str, dict[str, float]] = {}
    for goal in np.unique(objects):
        own = costs[np.ix_(objects == goal, objects == goal)]
        own = own[~np.eye(len(own), dtype=bool)]
        table[str(goal)] = {
            str(other): float(
                (own[:, None] < costs[np.ix_(objects == other, objects == goal)].ravel()).mean()
            )
            for other in np.unique(objects)
            if other != goal and len(own)
        }
    return {name: row for name, row in table.items() if row}
