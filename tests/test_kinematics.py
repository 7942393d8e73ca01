"""CasADi kinematics against MuJoCo, and the inverse against the forward."""

import mujoco
import numpy as np
import pytest

from touchgoal.control.errors import UserError
from touchgoal.control.kinematics import (
    FR3_HOME,
    FR3_LOWER,
    FR3_UPPER,
    UR5E,
    Fr3Kinematics,
    Ur5eKinematics,
    fingers_down,
    rotation_matrix,
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
    found = rotation_vector(rotation_matrix(angle * axis))
    assert min(np.linalg.norm(found - angle * axis), np.linalg.norm(found + angle * axis)) < 1e-5


def _ur5e_in_mujoco() -> mujoco.MjModel:
    """The UR5e from its lengths, joint by joint along the controller's base frame at q = 0.

    Written from the drawing (axis directions and distances), not from DH frames.
    """
    axes = [(0, 0, 1), (0, -1, 0), (0, -1, 0), (0, -1, 0), (0, 0, -1), (0, -1, 0)]
    offsets = [
        (0, 0, 0),
        (0, 0, 0.1625),
        (-0.425, 0, 0),
        (-0.3922, 0, 0),
        (0, -0.1333, 0),
        (0, 0, -0.0997),
    ]
    spec = mujoco.MjSpec()
    body = spec.worldbody
    for i, (axis, offset) in enumerate(zip(axes, offsets, strict=True)):
        body = body.add_body(pos=offset)
        body.add_joint(name=f"joint_{i}", axis=axis)
        body.add_geom(size=[0.01, 0, 0], mass=1.0)
    flange = body.add_site(name="flange", pos=[0, -0.0996, 0])
    flange.quat = np.array([np.sqrt(0.5), np.sqrt(0.5), 0, 0])  # z out of the flange, along -y
    return spec.compile()


def test_ur5e_matches_mujoco_and_its_inverse_returns() -> None:
    model = _ur5e_in_mujoco()
    data, arm, rng = mujoco.MjData(model), Ur5eKinematics(tcp_offset=0.0), np.random.default_rng(0)
    linear, angular = np.zeros((3, 6)), np.zeros((3, 6))
    for _ in range(50):
        q = rng.uniform(UR5E.lower, UR5E.upper)
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, linear, angular, 0)
        position, rotation = arm.forward(q)
        np.testing.assert_allclose(position, data.site_xpos[0], atol=1e-9)
        np.testing.assert_allclose(rotation, data.site_xmat[0].reshape(3, 3), atol=1e-9)
        np.testing.assert_allclose(arm.jacobian(q), np.vstack([linear, angular]), atol=1e-9)
    tool = Ur5eKinematics()
    for _ in range(50):
        position = rng.uniform([0.38, -0.25, 0.017], [0.62, 0.25, 0.3])
        rotation = fingers_down(rng.uniform(-1.5, 1.5))
        reached, _ = tool.forward(tool.reach(position, rotation, UR5E.home))
        assert np.linalg.norm(reached - position) < 1e-4
