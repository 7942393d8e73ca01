"""CasADi kinematics against MuJoCo, and the inverse against the forward."""

import mujoco
import numpy as np
import pytest

from touchgoal.control.errors import UserError
from touchgoal.control.kinematics import (
    FR3_HOME,
    FR3_LOWER,
    FR3_UPPER,
    Fr3Kinematics,
    fingers_down,
    rotation_vector,
)
from touchgoal.sim_envs.scene import build


def test_forward_and_jacobian_match_mujoco() -> None:
    model = build([]).compile()
    data, arm = mujoco.MjData(model), Fr3Kinematics()
    rng = np.random.default_rng(0)
    site = model.site("tcp").id
    linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    dofs = [model.joint(f"fr3_joint{i}").dofadr[0] for i in range(1, 8)]
    for _ in range(50):
        q = rng.uniform(FR3_LOWER, FR3_UPPER)
        data.qpos[:7] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, linear, angular, site)
        position, rotation = arm.forward(q)
        # The MJCF rounds the hand's quaternion to 7 digits.
        np.testing.assert_allclose(position, data.site_xpos[site], atol=1e-9)
        np.testing.assert_allclose(rotation, data.site_xmat[site].reshape(3, 3), atol=1e-7)
        expected = np.vstack([linear[:, dofs], angular[:, dofs]])
        np.testing.assert_allclose(arm.jacobian(q), expected, atol=1e-7)


def test_inverse_reaches_the_workspace_within_limits() -> None:
    arm, rng = Fr3Kinematics(), np.random.default_rng(1)
    for _ in range(100):
        position = rng.uniform([0.38, -0.25, 0.017], [0.62, 0.25, 0.35])
        rotation = fingers_down(rng.uniform(-1.5, 1.5))
        q = arm.reach(position, rotation, FR3_HOME)
        assert (q > FR3_LOWER).all() and (q < FR3_UPPER).all()
        reached, turned = arm.forward(q)
        assert np.linalg.norm(reached - position) < 1e-4
        assert np.linalg.norm(rotation_vector(turned @ rotation.T)) < 1e-3


def test_out_of_reach_is_said() -> None:
    with pytest.raises(UserError, match="cannot reach"):
        Fr3Kinematics().reach(np.array([1.5, 0, 0.2]), fingers_down(0), FR3_HOME)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.3, 2.0, np.pi - 1e-6, np.pi])
def test_rotation_vector_inverts_rodrigues(angle: float) -> None:
    axis = np.array([2.0, -1.0, 0.5]) / np.linalg.norm([2.0, -1.0, 0.5])
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    R = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    found = rotation_vector(R)
    assert min(np.linalg.norm(found - angle * axis), np.linalg.norm(found + angle * axis)) < 1e-5
