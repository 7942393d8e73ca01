"""An object of one's own from a mesh file: its size, its units, and a pick of it."""

from pathlib import Path

import numpy as np
import pytest

from touchgoal.policies.evaluation.evaluate import evaluate
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.scene.objects import find_object, sample_body

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


def hull_of(path: Path) -> np.ndarray:
    hull = find_object(str(path)).hull
    assert hull is not None
    return hull


def as_stl(box: Path, text: bool) -> Path:
    """Write an OBJ's triangles as STL, binary or text."""
    lines = [line.split()[1:] for line in box.read_text().splitlines()]
    corners = np.array(lines[:8], np.float32)
    triangles = [corners[np.array(line, int) - 1] for line in lines[8:]]
    if text:
        facets = "".join(
            "facet normal 0 0 0\n outer loop\n"
            + "".join(f"  vertex {x:e} {y:e} {z:e}\n" for x, y, z in triangle)
            + " endloop\nendfacet\n"
            for triangle in triangles
        )
        content = f"solid box\n{facets}endsolid box\n".encode()
    else:
        body = b"".join(bytes(12) + triangle.tobytes() + bytes(2) for triangle in triangles)
        content = (
            b"solid, says this binary file".ljust(80) + len(triangles).to_bytes(4, "little") + body
        )
    path = box.with_name(f"text_{text}.stl")
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("text", [False, True])
def test_stl_is_read_as_obj_is(text: bool, tmp_path: Path) -> None:
    box = write_box(tmp_path / "box.obj", (0.10, 0.04, 0.06), 20.0)
    np.testing.assert_allclose(
        np.ptp(hull_of(as_stl(box, text)), axis=0), [0.1, 0.04, 0.06], atol=2e-5
    )


def test_a_file_that_is_replaced_at_once_is_the_new_mesh(tmp_path: Path) -> None:
    for height in (0.05, 0.06, 0.07):
        hull = hull_of(write_box(tmp_path / "box.obj", (0.10, 0.04, height)))
        assert np.ptp(hull[:, 2]) == pytest.approx(height, abs=1e-4)


def test_size_and_unit_are_said_and_other_units_suggested(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    hull_of(write_box(tmp_path / "mug.obj", (0.08, 0.05, 0.06)))
    assert capsys.readouterr().err.endswith("mug.obj is 80 x 50 x 60 mm, read in metres\n")
    hull_of(write_box(tmp_path / "crate.obj", (24, 12, 10)))
    told = capsys.readouterr().err
    assert (
        "crate.obj is 24 x 12 x 10 mm, read in millimetres; if it is drawn in centimetres" in told
    )
    assert "it is 240 x 120 x 100 mm: scale the mesh by 10" in told
    with pytest.raises(
        UserError, match="6 x 4 x 4 mm, read in milli.* 60 x 40 x 40 mm: scale .* 10$"
    ):
        hull_of(write_box(tmp_path / "small.obj", (6, 4, 4)))
    with pytest.raises(
        UserError, match="in metres; .* drawn in centimetres, .*: scale .* by 0.01$"
    ):
        hull_of(write_box(tmp_path / "chip.obj", (0.95, 0.9, 0.9)))


@pytest.mark.parametrize(("unit", "degrees"), [(1.0, 0.0), (1.0, 70.0), (1000.0, -25.0)])
def test_the_hull_is_centred_in_metres_and_narrow_across_the_hand(
    unit: float, degrees: float, tmp_path: Path
) -> None:
    sides = 0.10 * unit, 0.04 * unit, 0.06 * unit
    hull = hull_of(write_box(tmp_path / f"box_{degrees}.obj", sides, degrees))
    np.testing.assert_allclose(hull.max(0), [0.05, 0.02, 0.03], atol=2e-5)
    np.testing.assert_allclose(hull.min(0), [-0.05, -0.02, -0.03], atol=2e-5)


def test_what_cannot_be_grasped_or_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        UserError, match="100 x 90 x 60 mm, read in metres; the hand .* along: scale the"
    ):
        hull_of(write_box(tmp_path / "wide.obj", (0.10, 0.09, 0.06)))
    text = tmp_path / "text.stl"
    for content in ("solid x\nendsolid x\n", "solid x\nvertex 1 2 x\nendsolid x\n"):
        text.write_text(content)
        with pytest.raises(UserError, match="text.stl is no solid mesh that can be read"):
            find_object(str(text))
    flat = tmp_path / "flat.obj"
    flat.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 3 4\n")
    with pytest.raises(UserError, match="is no solid mesh") as told:
        hull_of(flat)
    assert "STL" not in str(told.value)


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
