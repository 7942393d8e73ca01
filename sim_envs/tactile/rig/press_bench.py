"""Presses of one object into one fingertip sensor, without robot or physics."""

import mujoco
import numpy as np
from jaxtyping import Float

from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.sim_envs.scene.build import add_body, quaternion
from touchgoal.sim_envs.scene.contacts import PadContact
from touchgoal.sim_envs.scene.objects import Body
from touchgoal.sim_envs.tactile.pad import TactileFrame, TactilePad
from touchgoal.sim_envs.tactile.sensor_instance import SensorInstance, sample_instance


class PressBench:
    """Presses a body into the left sensor at a given place with a given force.

    Forces are prescribed, not solved for; an impossible press can be asked for, too.
    """

    contact: PadContact  # the pad's with the body in the last reading

    def __init__(
        self, body: Body, sensor: SensorModel, instance: SensorInstance, relief: bool = False
    ) -> None:
        self._model = _scene(body)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)
        self._name = body.name
        self._geoms = frozenset({int(self._model.body(body.name).geomadr[0])})
        self._pad = TactilePad(self._model, "left", sensor, instance, [body], relief)

    def place(
        self, position: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "3 3"] | None = None
    ) -> None:
        """Put the body at a pose in the sensor's frame, m."""
        site = self._data.site("left_sensor")
        R = site.xmat.reshape(3, 3)
        turned = R if rotation is None else R @ rotation
        self._data.joint(self._name).qpos = [*(site.xpos + R @ position), *quaternion(turned)]
        mujoco.mj_forward(self._model, self._data)

    def sense(
        self,
        force: float,
        rng: np.random.Generator,
        shear: tuple[float, float] = (0.0, 0.0),
        centre: tuple[float, float] = (0.0, 0.0),
        depth: float = 0.0,
        torsion: float = 0.0,
    ) -> TactileFrame:
        """Read the sensor.

        Args:
            force: normal force, N.
            rng: draws camera noise.
            shear: force along the sensor's x and y, N.
            centre: where the forces act, m in the sensor's frame, and
            depth: how far below the gel's rest plane, m.
            torsion: torque about the sensor's z at `centre`, Nm.
        """
        (x, y), (sx, sy) = centre, shear
        turning = x * sy - y * sx + torsion
        torque = np.array([-y * force + depth * sy, x * force - depth * sx, turning])
        self.contact = PadContact(np.array([sx, sy, -force]), torque, 0.0, self._geoms)
        return self._pad.sense(self._data, self.contact, rng)


def _scene(body: Body) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.worldbody.add_site(name="left_sensor")
    add_body(spec, body)
    return spec.compile()


def warm_up(bodies: list[Body], sensor: SensorModel) -> None:
    """Press and drag each body once, to load compiled code, which takes up to a second."""
    rng = np.random.default_rng(0)
    instance = sample_instance(sensor, rng)
    for body in bodies:
        bench = PressBench(body, sensor, instance)
        bench.place(np.zeros(3))
        for _ in range(2):  # the second reading continues the first one's shear
            bench.sense(1.0, rng, shear=(0.1, 0.0))
