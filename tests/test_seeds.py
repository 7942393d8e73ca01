"""Seeds of training, validation and test never meet."""

import ast
from itertools import pairwise
from pathlib import Path

import pytest

from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.seeds import CORRECTIONS, TRAINING, WIRES, SeedRange

ROOT = Path(__file__).parents[1]
FOLDERS = ("control", "sim_envs", "episodes", "encoders", "rewards", "policies", "benchmarks")
EPISODES = [*CORRECTIONS, *(r for r in vars(seeds).values() if isinstance(r, SeedRange))]


@pytest.mark.parametrize("ranges", [EPISODES, list(WIRES.values())], ids=["episodes", "wires"])
def test_no_two_ranges_overlap(ranges: list[SeedRange]) -> None:
    ordered = sorted(ranges, key=lambda r: r.start)
    assert all(a.stop <= b.start for a, b in pairwise(ordered))
    assert all(r.count > 0 for r in ordered)


def test_more_episodes_than_seeds_are_refused() -> None:
    assert TRAINING.first(TRAINING.count, "--episodes") == TRAINING.start
    with pytest.raises(UserError, match="--episodes is 100001"):
        TRAINING.first(TRAINING.count + 1, "--episodes")


def test_no_other_module_has_seeds_of_its_own() -> None:
    """A literal seed other than 0 stands in `runtime/seeds.py` alone."""
    found = []
    for path in (p for f in (*FOLDERS, "launch") for p in (ROOT / f).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.AnnAssign | ast.Assign):
                targets = [node.target] if isinstance(node, ast.AnnAssign) else node.targets
                named = "seed" in " ".join(ast.unparse(t) for t in targets).lower()
                value = node.value
                if named and isinstance(value, ast.Constant) and isinstance(value.value, int):
                    found += [f"{path.relative_to(ROOT)}:{node.lineno}"] * (value.value > 99)
    assert not found
