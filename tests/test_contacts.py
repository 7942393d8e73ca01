"""Forces and slip on the fingertips are those that MuJoCo's own functions tell, contact by contact."""

import mujoco
import numpy as np
import pytest

from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.config import BeadMazeConfig
from touchgoal.sim_envs.scene.build import SIDES


def test_wrenches_and_slip_are_mujocos() -> None:
    env = BeadMaze(BeadMazeConfig(cameras=(), tactile=False))
    env.reset(seed=3)
    for turn in [0.0] * 11 + [
        0.004
    ] * 4:  # rad a tick: across the wire, until the bead slips in the fingers
        env.step(np.append(np.full(env.n_joints, turn), 0.0))
    model, data = env.model, env.data
    external = np.zeros(6)
    tcp = data.site("tcp").xpos
    for pad, side in zip(env.pad_contacts(), SIDES, strict=True):
        site, geom = data.site(f"{side}_sensor"), model.geom(f"{side}_pad").id
        wrench, fastest, others = np.zeros(6), 0.0, set()
        for i in range(data.ncon):
            contact = data.contact[i]
            if geom not in contact.geom or contact.efc_address < 0:
                continue
            towards = 1.0 if contact.geom[1] == geom else -1.0
            felt = np.zeros(6)
            mujoco.mj_contactForce(model, data, i, felt)
            force, torque = towards * felt.reshape(2, 3) @ contact.frame.reshape(3, 3)
            wrench[:3] += force
            wrench[3:] += torque + np.cross(contact.pos - site.xpos, force)
            external[:3] += force
            external[3:] += torque + np.cross(contact.pos - tcp, force)
            sliding = np.diff([_velocity(env, g, contact.pos) for g in contact.geom], axis=0)[0]
            normal = contact.frame[:3]
            fastest = max(fastest, float(np.linalg.norm(sliding - normal * (normal @ sliding))))
            others |= set(contact.geom.tolist()) - {geom}
        local = wrench.reshape(2, 3) @ site.xmat.reshape(3, 3)
        np.testing.assert_allclose([pad.force, pad.torque], local, atol=1e-9)
        assert pad.slip_speed == pytest.approx(fastest, abs=1e-9)
        assert pad.geoms == others and others
    assert max(pad.slip_speed for pad in env.pad_contacts()) > 1e-3  # m/s
    # The wire touches no more of the robot than its bead.
    np.testing.assert_allclose(env.external_wrench(), external, atol=1e-9)


def _velocity(env: BeadMaze, geom: int, point: np.ndarray) -> np.ndarray:
    """Of a point (m, world frame) fixed to a geom, m/s."""
    twist, body = np.zeros(6), env.model.geom_bodyid[geom]
    mujoco.mj_objectVelocity(env.model, env.data, mujoco.mjtObj.mjOBJ_XBODY, body, twist, 0)
    return twist[3:] + np.cross(twist[:3], point - env.data.xpos[body])
