"""An object of one's own from a mesh file: its size, its units, and a pick of it."""

from pathlib import Path

import numpy as np
import pytest

from touchgoal.policies.evaluation.evaluate import evaluate
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.scene.objects import find_object, sample_body
from touchgoal.sim_envs.scene.own_object import read_hull

_FACES = "124 143 578 586 156 162 348 387 137 175 268 284"


def write_box(path: Path, sides: tuple[float, float, float], degrees: float = 0.0) -> Path:
    """Write a box away from the origin, turned about z, as OBJ."""
    t = np.deg2rad(degrees)
    turn = np.array([[np.cos(t), -np.sin(t), 0], [np.sin(t), np.cos(t), 0], [0, 0, 1]])
    corners = [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)] * np.array(sides)
    lines = ["v {:f} {:f} {:f}".format(*(turn @ corner + 0.3 * max(sides))) for corner in corners]
    lines += [f"f {a} {b} {c}" for a, b, c in _FACES.split()]
    path.write_text("\n".join(lines))
    return path


@pytest.mark.parametrize(("unit", "degrees"), [(1.0, 0.0), (1.0, 70.0), (1000.0, -25.0)])
def test_the_hull_is_centred_in_metres_and_narrow_across_the_hand(
    unit: float, degrees: float, tmp_path: Path
) -> None:
    sides = 0.10 * unit, 0.04 * unit, 0.06 * unit
    hull = read_hull(write_box(tmp_path / f"box_{degrees}.obj", sides, degrees))
    np.testing.assert_allclose(hull.max(0), [0.05, 0.02, 0.03], atol=2e-5)
    np.testing.assert_allclose(hull.min(0), [-0.05, -0.02, -0.03], atol=2e-5)


def test_what_cannot_be_grasped_or_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is 100 x 90 x 60 mm; the hand grasps 8 to 76 mm across"):
        read_hull(write_box(tmp_path / "wide.obj", (0.10, 0.09, 0.06)))
    text = tmp_path / "text.stl"
    text.write_text("solid x\nendsolid x\n")
    with pytest.raises(UserError, match="STL must be binary"):
        find_object(str(text))
    flat = tmp_path / "flat.obj"
    flat.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 3 4\n")
    with pytest.raises(UserError, match="is no solid mesh"):
        read_hull(flat)


@pytest.mark.slow
def test_the_expert_places_an_object_of_ones_own(tmp_path: Path) -> None:
    mesh = write_box(tmp_path / "my_bracket.obj", (0.10, 0.03, 0.06), 40.0)
    kind = find_object(str(mesh))
    assert kind.descriptions == ("my bracket",)
    assert sample_body(kind, np.random.default_rng(0), 0.1).rest_height == pytest.approx(
        0.03, abs=1e-4
    )
    env = PickPlaceConfig(objects=(str(mesh),), tactile=False, cameras=())
    assert evaluate("expert", env, episodes=2, workers=1).rate.successes == 2
