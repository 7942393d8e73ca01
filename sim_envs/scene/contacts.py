"""Contacts of the solver: wrenches and slip at the fingertips, external force."""

from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import mujoco
import numpy as np
from jaxtyping import Float, Int
from numba import njit

from touchgoal.sim_envs.scene.build import SIDES

_IS_CONTACT = np.zeros(16, bool)  # by constraint type: whether it is a contact (elliptic cones)
_IS_CONTACT[int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)] = True
_IS_CONTACT[int(mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC)] = True
SLIP_SPEED = 1e-3  # m/s of sliding between pad and object that counts as slip


@dataclass(frozen=True)
class PadContact:
    """One pad's contact."""

    # force, torque: on the pad, N and Nm, in the sensor frame about its origin; a squeeze is a
    # negative z force
    force: Float[np.ndarray, "3"]
    torque: Float[np.ndarray, "3"]
    slip_speed: float  # speed of the fastest contact point over the pad, m/s
    geoms: frozenset[int]  # ids of the geoms that touch the pad

    @property
    def touching(self) -> bool:
        """Whether anything presses on the pad."""
        return bool(self.geoms)

    @property
    def normal_force(self) -> float:
        """N, positive when pressed."""
        return max(0.0, -float(self.force[2]))


class ContactReader:
    """Reads a model's contacts, in one pass per control tick."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._pads = {model.geom(f"{side}_pad").id: i for i, side in enumerate(SIDES)}
        self._pad_of = np.full(model.ngeom, -1)  # by geom: 0 left, 1 right, -1 none
        self._pad_of[list(self._pads)] = list(self._pads.values())
        self._sensors = [model.site(f"{side}_sensor").id for side in SIDES]
        self._tcp = model.site("tcp").id
        base = model.body("base").id
        rooted = model.body_rootid[model.geom_bodyid] == model.body_rootid[base]
        self._is_robot = rooted & (model.geom_bodyid != 0)

    def read(
        self, data: mujoco.MjData
    ) -> tuple[tuple[PadContact, PadContact], Float[np.ndarray, "6"]]:
        """Return the pads' contacts, and the external wrench (N, Nm) on the robot at the TCP.

        The wrench is in the base frame.
        """
        contacts, model = _contacts(data), self._model
        wrenches, slip = _read_contacts(
            contacts,
            data.efc_force,
            self._is_robot,
            self._pad_of,
            data.site_xpos[[*self._sensors, self._tcp]],
            BodyMotion(model.geom_bodyid, model.body_rootid, data.cvel, data.subtree_com),
        )
        touching: tuple[set[int], set[int]] = set(), set()
        for pair, address in zip(contacts.geoms.tolist(), contacts.addresses.tolist(), strict=True):
            for geom, other in (pair, pair[::-1]):
                if address >= 0 and geom in self._pads:
                    touching[self._pads[geom]].add(other)

        def pad(side: int) -> PadContact:
            axes = data.site_xmat[self._sensors[side]].reshape(3, 3)
            force, torque = wrenches[side].reshape(2, 3) @ axes
            return PadContact(force, torque, float(slip[side]), frozenset(touching[side]))

        return (pad(0), pad(1)), wrenches[2]

    def external_force(self, data: mujoco.MjData) -> Float[np.ndarray, "3"]:
        """Return the force (N, base frame) of `read`'s external wrench, in a fraction of its time."""
        return _force_on(self._is_robot, _contacts(data), data.efc_force)

    def joint_torque(self, data: mujoco.MjData) -> Float[np.ndarray, " nv"]:
        """Return the generalised force of all contacts, J^T f; internal forces cancel."""
        contact = _IS_CONTACT[data.efc_type]
        jacobian = data.efc_J.reshape(-1, self._model.nv)
        return data.efc_force[contact] @ jacobian[contact]

    def load(self, data: mujoco.MjData, geom: int) -> float:
        """Return the force (N) that presses down on a geom."""
        chosen = np.arange(self._model.ngeom) == geom
        return 0.0 - float(_force_on(chosen, _contacts(data), data.efc_force)[2])  # never -0

    def touches(self, data: mujoco.MjData, one: int, other: int) -> bool:
        """Return whether two geoms are in contact."""
        return any({int(g) for g in pair} == {one, other} for pair in data.contact.geom)


class Contacts(NamedTuple):
    """MuJoCo's contacts as arrays, one row per contact."""

    geoms: Int[np.ndarray, "k 2"]
    frames: Float[np.ndarray, "k 9"]
    points: Float[np.ndarray, "k 3"]
    addresses: Int[np.ndarray, " k"]
    sizes: Int[np.ndarray, " k"]


def _contacts(data: mujoco.MjData) -> Contacts:
    found = data.contact
    return Contacts(found.geom, found.frame, found.pos, found.efc_address, found.dim)


class BodyMotion(NamedTuple):
    """Bodies of geoms, and velocities of bodies about their tree's centre of mass."""

    bodies: Int[np.ndarray, " geoms"]
    roots: Int[np.ndarray, " bodies"]
    velocities: Float[np.ndarray, "bodies 6"]
    centres: Float[np.ndarray, "bodies 3"]


@njit(cache=True)
@no_type_check
def _read_contacts(contacts, forces, is_robot, pad_of, origins, moving):
    """Return wrenches (N, Nm, world frame) on pads and robot about their origins, and slip (m/s)."""
    wrenches, slip = np.zeros((3, 6)), np.zeros(2)
    for i in range(contacts.addresses.size):
        first, second = contacts.geoms[i]
        address, point = contacts.addresses[i], contacts.points[i]
        if address < 0 or not (is_robot[first] or is_robot[second]):
            continue
        # With elliptic cones the rows are the first geom's wrench on the second, contact frame.
        force, torque = np.zeros(3), np.zeros(3)
        for k in range(contacts.sizes[i]):
            axis = contacts.frames[i, 3 * (k % 3) : 3 * (k % 3) + 3]
            part = force if k < 3 else torque
            part += forces[address + k] * axis
        if is_robot[first] != is_robot[second]:
            sign = 1.0 if is_robot[second] else -1.0
            _add_wrench(wrenches[2], sign, force, torque, point - origins[2])
        for k in range(2):
            side = pad_of[contacts.geoms[i, k]]
            if side < 0:
                continue
            _add_wrench(wrenches[side], 2.0 * k - 1.0, force, torque, point - origins[side])
            normal = contacts.frames[i, :3]
            relative = _velocity(moving, second, point) - _velocity(moving, first, point)
            relative -= normal * (normal * relative).sum()
            slip[side] = max(slip[side], np.sqrt((relative**2).sum()))
    return wrenches, slip


@njit(cache=True)
@no_type_check
def _force_on(chosen, contacts, forces):
    """Return the force (N, world frame) of all other geoms on the chosen ones."""
    total = np.zeros(3)
    for i in range(contacts.addresses.size):
        first, second = contacts.geoms[i]
        address = contacts.addresses[i]
        if address < 0 or chosen[first] == chosen[second]:
            continue
        sign = 1.0 if chosen[second] else -1.0
        for k in range(min(contacts.sizes[i], 3)):
            total += sign * forces[address + k] * contacts.frames[i, 3 * k : 3 * k + 3]
    return total


@njit(inline="always")
@no_type_check
def _add_wrench(total, sign, force, torque, arm):
    total[:3] += sign * force
    total[3:] += sign * (np.cross(arm, force) + torque)


@njit(inline="always")
@no_type_check
def _velocity(moving, geom, point):
    """Return the velocity (m/s) of a point (m, world frame) fixed to a geom."""
    body = moving.bodies[geom]
    twist = moving.velocities[body]
    return twist[3:] + np.cross(twist[:3], point - moving.centres[moving.roots[body]])
