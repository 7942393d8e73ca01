"""The arm's gap to itself: capsules that cover the meshes, exact distances, moves that are refused."""

import numpy as np
import pytest

from touchgoal.control.motion.arm_models import FR3_ARM
from touchgoal.control.motion.kinematics import Fr3Kinematics, Kinematics
from touchgoal.control.motion.rotations import fingers_down
from touchgoal.control.motion.self_collision import (
    SelfDistance,
    require_no_self_collision,
    segment_distance,
)
from touchgoal.control.motion.trajectories import joint_move
from touchgoal.control.safety import limits as robots
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.scene.build import build


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
    robot, arm, rng = robots.FR3, Fr3Kinematics(), np.random.default_rng(1)
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
