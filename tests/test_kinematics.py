"""Kinematics against pinocchio and MuJoCo; distances of the arm to itself."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from fake_cell import SIM, FakeCell, write_cell_file

from touchgoal.control import features as ft
from touchgoal.control.cell.cell_file import read_cell_file
from touchgoal.control.deployment.preflight import preflight
from touchgoal.control.motion.arm_models import FR3_ARM
from touchgoal.control.motion.kinematics import Kinematics
from touchgoal.control.motion.rotations import fingers_down, rotation_matrix, rotation_vector
from touchgoal.control.motion.self_collision import (
    SelfDistance,
    require_no_self_collision,
    segment_distance,
)
from touchgoal.control.motion.trajectories import joint_move
from touchgoal.control.safety import limits as robots
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.scene.build import SceneConfig, build

if TYPE_CHECKING:
    import mujoco

UR5E = robots.UR5E.kinematics()
BOTH_ARMS = pytest.mark.parametrize("arm", [robots.FR3.kinematics(), UR5E], ids=["FR3", "UR5e"])
POSES = 1000
NEAR = 0.2  # rad, farthest that a joint is from the solution at the start
_EDGE = 0.05  # rad from its limit in which a joint counts as near it
_CANDIDATES = 50  # postures of which the one nearest to a singularity is taken


def near_tasks(
    kinematics: Kinematics, count: int, rng: np.random.Generator
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Goals (rad) anywhere, near limits and near singularities in turn, and starts near them."""
    lower, upper = kinematics.arm.limits.lower + 1e-3, kinematics.arm.limits.upper - 1e-3
    for k in range(count):
        q = rng.uniform(lower, upper)
        if k % 3 == 1:
            at = rng.choice(q.size, rng.integers(1, 4), replace=False)
            inwards, low = rng.uniform(0, _EDGE, at.size), rng.random(at.size) < 0.5
            q[at] = np.where(low, lower[at] + inwards, upper[at] - inwards)
        elif k % 3 == 2:
            candidates = rng.uniform(lower, upper, (_CANDIDATES, q.size))
            _, _, jacobians = kinematics.forward_many(candidates)
            least = np.linalg.svd(jacobians, compute_uv=False)[:, -1]
            q = candidates[np.argmin(least)]
        yield q, np.clip(q + rng.uniform(-NEAR, NEAR, q.size), lower, upper)


def against_mujoco(model: "mujoco.MjModel", arm: Kinematics, site: str, dofs: list[int]) -> None:
    """Position, rotation and Jacobian to 1e-9 at random joint positions over the whole range."""
    import mujoco  # after touchgoal, which chooses the OpenGL platform

    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    index = model.site(site).id
    for _ in range(POSES):
        q = rng.uniform(arm.arm.limits.lower, arm.arm.limits.upper)
        data.qpos[dofs] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, linear, angular, index)
        position, rotation = arm.forward(q)
        np.testing.assert_allclose(position, data.site_xpos[index], atol=1e-9)
        np.testing.assert_allclose(rotation, data.site_xmat[index].reshape(3, 3), atol=1e-9)
        expected = np.vstack([linear[:, dofs], angular[:, dofs]])
        np.testing.assert_allclose(arm.jacobian(q), expected, atol=1e-9)


def test_fr3_matches_mujoco() -> None:
    spec = build([])
    # Franka's MJCF rounds half of -45 degrees to 7 digits.
    spec.body("hand").quat = np.array([np.cos(np.pi / 8), 0, 0, -np.sin(np.pi / 8)])
    model = spec.compile()
    dofs = [int(model.joint(f"fr3_joint{i}").dofadr[0]) for i in range(1, 8)]
    against_mujoco(model, robots.FR3.kinematics(), "tcp", dofs)


def test_out_of_reach_is_said() -> None:
    with pytest.raises(UserError, match="cannot reach"):
        robots.FR3.kinematics().solve_ik(np.array([1.5, 0, 0.2]), fingers_down(0), FR3_ARM.home)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.3, 2.0, np.pi - 1e-6, np.pi])
def test_rotation_vector_inverts_rodrigues(angle: float) -> None:
    axis = np.array([2.0, -1.0, 0.5]) / np.linalg.norm([2.0, -1.0, 0.5])
    found = rotation_vector(rotation_matrix(angle * axis))
    assert min(np.linalg.norm(found - angle * axis), np.linalg.norm(found + angle * axis)) < 1e-5


def test_the_simulated_ur5e_is_the_makers() -> None:
    """Masses; centres of mass where Universal Robots' ROS description has them; a 2F-85's length.

    Its link frames are at the joints, moved along their axes by the table's d.
    """
    model = build([], SceneConfig(arm="ur5e")).compile()
    centres = [
        (0, -0.00193, 0.1625 - 0.02561),
        (-0.2125, 0, 0.11336),
        (-0.2422, 0, 0.0265),
        (0, -0.01634, 0.1333 - 0.0018),
        (0, 0.01634, 0.0997 - 0.0018),
        (0, 0, 0.0996 - 0.001159),
    ]
    masses = (3.761, 8.058, 2.846, 1.37, 1.3, 0.365)
    for i, (mass, centre) in enumerate(zip(masses, centres, strict=True), 1):
        link = model.body(f"ur5e_link{i}")
        assert link.mass[0] == pytest.approx(mass)
        np.testing.assert_allclose(link.ipos, centre, atol=1e-6)
    gels = model.body("left_gel").mass[0] + model.body("right_gel").mass[0]
    assert model.body("hand").subtreemass[0] - gels == pytest.approx(0.925)
    assert model.site("tcp").pos[2] == pytest.approx(0.0108 + 0.1628 - 0.01875)
    assert 2 * model.joint("finger_joint1").range[1] == pytest.approx(0.085)
    dofs = [int(model.joint(f"ur5e_joint{i}").dofadr[0]) for i in range(1, 7)]
    against_mujoco(model, UR5E, "tcp", dofs)


@pytest.mark.parametrize("posture", [0.02, 0.0])
@BOTH_ARMS
def test_near_poses_are_reached_at_singularities_too(arm: Kinematics, posture: float) -> None:
    """99 % of poses from 0.2 rad off; what is called reached is there, and near."""
    limits, reached = arm.arm.limits, 0
    for q, start in near_tasks(arm, POSES, np.random.default_rng(3)):
        position, rotation = arm.forward(q)
        solution = arm.solve_ik_near(position, rotation, start, posture=posture)
        assert (solution.q >= limits.lower).all() and (solution.q <= limits.upper).all()
        if solution.reached:
            reached += 1
            found, turned = arm.forward(solution.q)
            assert np.linalg.norm(found - position) < 1e-4
            assert np.linalg.norm(rotation_vector(turned @ rotation.T)) < 1e-3
            assert np.abs(solution.q - start).max() < 1
    assert reached >= 0.99 * POSES


@BOTH_ARMS
def test_what_is_reachable_is_reached_in_any_orientation(arm: Kinematics) -> None:
    """999 of 1000 poses that some joint positions have, inside the box over the table."""
    rng, limits, home = np.random.default_rng(7), arm.arm.limits, arm.arm.home
    lower, upper = np.maximum(limits.lower, -np.pi) + 0.05, np.minimum(limits.upper, np.pi) - 0.05
    missed, count = 0, 0
    while count < POSES:
        position, rotation = arm.forward(rng.uniform(lower, upper))
        if not (np.abs(position - [0.5, 0, 0.3]) < [0.25, 0.45, 0.3]).all():
            continue
        count += 1
        try:
            q = arm.solve_ik(position, rotation, home)
        except UserError:
            missed += 1
            continue
        assert (q > limits.lower).all() and (q < limits.upper).all()
        reached, turned = arm.forward(q)
        assert np.linalg.norm(reached - position) < 1e-4
        assert np.linalg.norm(rotation_vector(turned @ rotation.T)) < 1e-3
    assert missed <= POSES // 1000


def test_the_capsules_cover_the_arms_meshes() -> None:
    """Every corner of every collision mesh, at a posture, to a millimetre."""
    import mujoco  # after touchgoal, which chooses the OpenGL platform

    model = build([]).compile()
    data, distance = mujoco.MjData(model), SelfDistance(FR3_ARM)
    data.qpos[:7] = FR3_ARM.home
    mujoco.mj_kinematics(model, data)
    ends = np.array([p for c in distance.body for p in (c.start, c.end)])
    frames = [c.frame for c in distance.body for _ in range(2)]
    placed = (
        Kinematics(FR3_ARM, 0.0)
        .points_on_links(ends, frames)(FR3_ARM.home)
        .full()
        .T.reshape(-1, 2, 3)
    )
    names = [f"fr3_link{i}" for i in range(8)] + ["hand"]
    for part, name in enumerate(names):
        geom = model.body(name).geomadr[0]
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        corners = model.mesh_vert[first : first + count] @ data.geom_xmat[geom].reshape(3, 3).T
        corners = corners + data.geom_xpos[geom]
        outside = np.min(
            [
                segment_distance(corners, corners, *np.broadcast_to(axis, (2, count, 3)))
                - capsule.radius
                for axis, capsule in zip(placed[:, :, None], distance.body, strict=True)
                if capsule.frame == part
            ],
            axis=0,
        )
        assert outside.max() < 1e-3, name


def test_segment_distance_is_the_least_over_all_points() -> None:
    rng = np.random.default_rng(0)
    share = np.linspace(0, 1, 201)
    for scale in (1.0, 0.2):
        a, b, c, d = scale * rng.normal(size=(4, 50, 3))
        d[:10] = c[:10] + 0.5 * (b[:10] - a[:10])  # parallel
        first = a[:, None] + share[:, None] * (b - a)[:, None]
        second = c[:, None] + share[:, None] * (d - c)[:, None]
        least = np.linalg.norm(first[:, :, None] - second[:, None], axis=-1).min((1, 2))
        found = segment_distance(a, b, c, d)
        assert (found <= least + 1e-12).all() and (found > least - 0.01 * scale).all()


def test_moves_over_the_table_are_free_and_one_into_the_arm_itself_is_not() -> None:
    robot, arm, rng = robots.FR3, robots.FR3.kinematics(), np.random.default_rng(1)
    distance, q = SelfDistance(FR3_ARM), FR3_ARM.home
    for _ in range(20):
        position = rng.uniform([0.38, -0.25, 0.02], [0.62, 0.25, 0.35])
        goal = arm.solve_ik(position, fingers_down(rng.uniform(-1.5, 1.5)), FR3_ARM.home)
        require_no_self_collision(joint_move(q, goal, robot.policy), distance)
        q = goal
    folded = np.array([0.0, -0.6, 0.0, -2.9, 0.0, 0.8, 0.8])  # the hand into the shoulder
    assert distance.gap(folded[None])[0] < 0
    with pytest.raises(UserError, match="of itself"):
        require_no_self_collision(joint_move(FR3_ARM.home, folded, robot.policy), distance)


@pytest.mark.parametrize(
    ("mm", "told"),
    [
        (0.5, "tool 0.5 mm from where the controller has it"),
        (1.5, "tool 1.5 mm .*; the arm's own calibration is not used"),
        (9.5, "tool 9.5 mm .*; the arm's own calibration is not used"),
        (10.5, "tool 10.5 mm .*: is it no FR3[?] set the cell file's arm"),
    ],
)
def test_the_preflight_names_kinematics_that_differ_from_the_controllers(
    mm: float, told: str, tmp_path: Path
) -> None:
    cell = FakeCell()
    tcp, _ = robots.FR3.kinematics().forward(cell.arm.reading.q)
    cell.arm.reading = replace(cell.arm.reading, tcp=tcp + 1e-3 * mm * np.array([0.6, 0.0, -0.8]))
    file, safety = write_cell_file(tmp_path, SIM), ActionFilter(robots.FR3, ft.CONTROL_HZ)
    lines = preflight(read_cell_file(file), cell.connection(), safety, tmp_path, lambda: 0)
    [line] = [line for line in lines if line.name == "kinematics"]
    assert line.ok == (mm < 10) and re.fullmatch(told + ".*" * (mm > 1), line.detail or line.remedy)
