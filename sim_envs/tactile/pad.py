"""The simulated fingertip sensor: what a GelSight would show for the scene as it is now."""

from dataclasses import dataclass

import cv2
import mujoco
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from touchgoal.control.sensors import SensorModel
from touchgoal.sim_envs.contact import PadContact
from touchgoal.sim_envs.objects import Body
from touchgoal.sim_envs.rendering import open_renderer
from touchgoal.sim_envs.scene import OBJECT_GROUP, PAD_CAMERA_DISTANCE
from touchgoal.sim_envs.tactile.geometry import (
    BOX,
    CAPSULE,
    CYLINDER,
    NO_SURFACE,
    SPHERE,
    Grid,
    add_texture,
    primitive_height,
    settle,
)
from touchgoal.sim_envs.tactile.optics import Unit, deform, render, render_untouched

_PRIMITIVES = {
    int(mujoco.mjtGeom.mjGEOM_BOX): BOX,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): CYLINDER,
    int(mujoco.mjtGeom.mjGEOM_SPHERE): SPHERE,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): CAPSULE,
}
# Geometry at half the image's resolution: between two of its rays a 20 mm ball deviates from a
# straight line by 0.09 um. The force balance, over the whole gel, needs a quarter.
_FINE, _COARSE = 2, 4


@dataclass(frozen=True)
class TactileFrame:
    """One sensor reading.

    Attributes:
        image: what the camera sees, RGB.
        depth: of the gel's surface below its rest plane, m.
        mask: where an object touches the gel.
    """

    image: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]
    mask: Bool[np.ndarray, "h w"]


class TactilePad:
    """One fingertip's sensor in a compiled model.

    The exact normal force comes from the solver, the shape of the contact from geometry: objects
    are pushed into the gel until an elastic foundation carries that force. The geometry is taken
    in the sensor's frame, which the case carries, so that shear moves the contact in the image.
    """

    def __init__(
        self, model: mujoco.MjModel, side: str, sensor: SensorModel, unit: Unit, bodies: list[Body]
    ) -> None:
        self._model, self._side, self._sensor, self._unit = model, side, sensor, unit
        self._site = model.site(f"{side}_sensor").id
        self._bodies = {model.geom(body.name).id: body for body in bodies}
        rows, columns = sensor.image_shape
        self._fine_grid = Grid(rows // _FINE, columns // _FINE, sensor.pixel_pitch * _FINE)
        self._coarse_grid = _gel_grid(sensor, _COARSE)
        self._mesh_grid = _gel_grid(sensor, _FINE)
        # An orthographic camera's fovy is the height it sees, m; the width follows from the aspect.
        model.cam_fovy[model.camera(f"{side}_gel").id] = (
            self._mesh_grid.rows * self._mesh_grid.pitch
        )
        self._renderer: mujoco.Renderer | None = None

    def sense(
        self, data: mujoco.MjData, contact: PadContact, rng: np.random.Generator
    ) -> TactileFrame:
        """The reading for the present state; nothing is computed for a pad that touches nothing."""
        shape = self._sensor.image_shape
        body, geom = self._touched(contact)
        if body is None or contact.normal_force <= 0:
            flat = np.zeros(shape, np.float32)
            return TactileFrame(render_untouched(self._unit, rng), flat, np.zeros(shape, bool))
        raw = self._overlap(data, geom, body, contact.normal_force)
        surface = deform(raw, self._sensor.pixel_pitch)
        image = render(surface, self._sensor.pixel_pitch, self._unit, rng)
        return TactileFrame(image, surface, raw > 0)

    def close(self) -> None:
        """Free the OpenGL context, if meshes needed one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _touched(self, contact: PadContact) -> tuple[Body | None, int]:
        """The object on the pad; the scene's own parts (table, case) leave no picture."""
        for geom in sorted(contact.geoms):
            if geom in self._bodies:
                return self._bodies[geom], geom
        return None, -1

    def _overlap(
        self, data: mujoco.MjData, geom: int, body: Body, force: float
    ) -> Float32[np.ndarray, "h w"]:
        """How deep the object sits in the gel over the image, m."""
        material, gel = body.kind.material, self._sensor.foundation_modulus
        R = data.site_xmat[self._site].reshape(3, 3)
        rotation = R.T @ data.geom_xmat[geom].reshape(3, 3)
        position = R.T @ (data.geom_xpos[geom] - data.site_xpos[self._site])
        height, coarse = self._heights(data, geom, position, rotation)
        # Gel and object in series: the softer one takes the larger share of the overlap.
        modulus = 1 / (1 / gel + 1 / material.foundation_modulus)
        shift = settle(coarse, self._sensor.pixel_pitch * _COARSE, force, modulus)
        height += np.float32(shift)
        add_texture(
            height,
            self._fine_grid.pitch,
            -2 * material.amplitude,
            material.texture,
            material.amplitude,
            material.wavelength,
            position + np.array([0, 0, -shift]),
            rotation,
        )
        rows, columns = self._sensor.image_shape
        height = cv2.resize(height, (columns, rows), interpolation=cv2.INTER_LINEAR)
        return np.maximum(height, np.float32(0)) * np.float32(modulus / gel)

    def _heights(
        self, data: mujoco.MjData, geom: int, position: np.ndarray, rotation: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Height fields over the image (fine grid) and over the whole gel (coarse grid), m."""
        kind = _PRIMITIVES.get(int(self._model.geom_type[geom]))
        if kind is not None:
            pose = kind, position, rotation, self._model.geom_size[geom]
            return (
                primitive_height(self._fine_grid, *pose),
                primitive_height(self._coarse_grid, *pose),
            )
        whole = self._mesh_height(data)
        h, w = self._fine_grid.rows, self._fine_grid.columns
        top, left = (whole.shape[0] - h) // 2, (whole.shape[1] - w) // 2
        step = _COARSE // _FINE
        fine = whole[top : top + h, left : left + w].copy()
        return fine, np.ascontiguousarray(whole[::step, ::step])

    def _mesh_height(self, data: mujoco.MjData) -> Float32[np.ndarray, "h w"]:
        """Height field of everything in the object group, by the camera inside the sensor."""
        if self._renderer is None:
            self._renderer = _depth_renderer(self._model, self._mesh_grid)
        options = mujoco.MjvOption()
        options.geomgroup[:] = 0
        options.geomgroup[OBJECT_GROUP] = 1
        self._renderer.update_scene(data, f"{self._side}_gel", options)
        distance = self._renderer.render()
        height = np.float32(PAD_CAMERA_DISTANCE) - distance
        return np.where(distance < 0.1, height, NO_SURFACE)


def _gel_grid(sensor: SensorModel, scale: int) -> Grid:
    """The whole gel at 1/scale of the image's resolution; sizes are multiples of four."""
    pitch = sensor.pixel_pitch * scale
    columns, rows = (4 * round(size / pitch / 4) for size in sensor.gel_size)
    return Grid(rows, columns, pitch)


def _depth_renderer(model: mujoco.MjModel, grid: Grid) -> mujoco.Renderer:
    quality = model.vis.quality
    kept = quality.offsamples, quality.shadowsize
    quality.offsamples, quality.shadowsize = 0, 0  # multisampling would blend depths at edges
    renderer = open_renderer(model, grid.rows, grid.columns)
    quality.offsamples, quality.shadowsize = kept
    renderer.enable_depth_rendering()
    return renderer
