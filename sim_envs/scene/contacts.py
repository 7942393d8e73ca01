"""What the solver's contacts say about the fingertips: wrenches, slip, external force."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from touchgoal.sim_envs.scene.build import SIDES

# Which of the solver's kinds of constraint are contacts (with elliptic cones).
_IS_CONTACT = np.zeros(16, bool)
_IS_CONTACT[int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)] = True
_IS_CONTACT[int(mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC)] = True
SLIP_SPEED = 1e-3  # m/s of sliding between pad and object that counts as slip


@dataclass(frozen=True)
class PadContact:
    """One pad's contact.

    Attributes:
        force, torque: of the object on the pad, N and Nm, in the sensor frame about its origin;
            a squeeze is a negative z force.
        slip_speed: of the object over the pad, m/s, the fastest contact point.
        geoms: ids of the geoms that touch the pad.
    """

    force: Float[np.ndarray, "3"]
    torque: Float[np.ndarray, "3"]
    slip_speed: float
    geoms: frozenset[int]

    @property
    def touching(self) -> bool:
        """Whether anything presses on the pad."""
        return bool(self.geoms)

    @property
    def normal_force(self) -> float:
        """N, positive when pressed."""
        return max(0.0, -float(self.force[2]))


class ContactReader:
    """Reads a model's contacts; one pass over them a control tick."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._pads = {model.geom(f"{side}_pad").id: i for i, side in enumerate(SIDES)}
        self._sensors = [model.site(f"{side}_sensor").id for side in SIDES]
        self._tcp = model.site("tcp").id
        base = model.body("base").id
        rooted = model.body_rootid[model.geom_bodyid] == model.body_rootid[base]
        self._is_robot = rooted & (model.geom_bodyid != 0)

    def read(
        self, data: mujoco.MjData
    ) -> tuple[tuple[PadContact, PadContact], Float[np.ndarray, "6"]]:
        """The left and the right pad's contact, and the external wrench.

        The wrench is the force (N) and torque (Nm) of everything outside on the robot, at the TCP,
        in the base frame.
        """
        force, torque = np.zeros((2, 3)), np.zeros((2, 3))
        slip: list[float] = [0.0, 0.0]
        geoms: list[set[int]] = [set(), set()]
        external = np.zeros(6)
        for i in range(data.ncon):
            contact = data.contact[i]
            first, second = (int(g) for g in contact.geom)
            if contact.efc_address < 0 or not (self._is_robot[first] or self._is_robot[second]):
                continue
            f, t = self._wrench(data, i, contact)
            if self._is_robot[first] != self._is_robot[second]:
                sign = 1.0 if self._is_robot[second] else -1.0
                arm = contact.pos - data.site_xpos[self._tcp]
                external += sign * np.concatenate([f, _cross(arm, f) + t])
            for own, other, sign in ((first, second, -1.0), (second, first, 1.0)):
                side = self._pads.get(own)
                if side is None:
                    continue
                site = self._sensors[side]
                R = data.site_xmat[site].reshape(3, 3)
                arm = contact.pos - data.site_xpos[site]
                force[side] += sign * R.T @ f
                torque[side] += sign * R.T @ (_cross(arm, f) + t)
                slip[side] = max(slip[side], self._sliding_speed(data, contact))
                geoms[side].add(other)
        left, right = (
            PadContact(force[s], torque[s], slip[s], frozenset(geoms[s])) for s in range(2)
        )
        return (left, right), external

    def joint_torque(self, data: mujoco.MjData) -> Float[np.ndarray, " nv"]:
        """Generalised force of all contacts, J^T f; what the hand does to itself cancels out."""
        contact = _IS_CONTACT[data.efc_type]
        jacobian = data.efc_J.reshape(-1, self._model.nv)
        return data.efc_force[contact] @ jacobian[contact]

    def load(self, data: mujoco.MjData, geom: int) -> float:
        """Force (N) with which everything presses down on a geom."""
        force = 0.0
        for i in range(data.ncon):
            contact = data.contact[i]
            if geom in contact.geom and contact.efc_address >= 0:
                f, _ = self._wrench(data, i, contact)
                force += -f[2] if contact.geom[1] == geom else f[2]
        return float(force)

    def touches(self, data: mujoco.MjData, one: int, other: int) -> bool:
        """Whether two geoms are in contact."""
        return any({int(g) for g in pair} == {one, other} for pair in data.contact.geom)

    def _wrench(
        self, data: mujoco.MjData, index: int, contact: mujoco.MjContact
    ) -> tuple[np.ndarray, np.ndarray]:
        """World-frame force and torque of a contact's first geom on its second."""
        wrench = np.zeros(6)
        mujoco.mj_contactForce(self._model, data, index, wrench)
        frame = contact.frame.reshape(3, 3)
        return frame.T @ wrench[:3], frame.T @ wrench[3:]

    def _sliding_speed(self, data: mujoco.MjData, contact: mujoco.MjContact) -> float:
        """Tangential speed of one surface over the other at a contact point, m/s."""
        velocities = []
        for geom in contact.geom:
            twist = np.zeros(6)
            body = self._model.geom_bodyid[geom]
            mujoco.mj_objectVelocity(self._model, data, mujoco.mjtObj.mjOBJ_XBODY, body, twist, 0)
            velocities.append(twist[3:] + _cross(twist[:3], contact.pos - data.xpos[body]))
        relative = velocities[1] - velocities[0]
        normal = contact.frame[:3]
        return float(np.linalg.norm(relative - normal * (normal @ relative)))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """np.cross of two 3-vectors, without its 30 us of checks."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
