"""The simulated fingertip sensor: its image, depth and forces for the present scene.

Where friction pulls along the gel its surface rises and falls, the trace of shear without dots. The gel is
the layer of `markers.layer_compliance`: a load squeezes the surface aside by minus S times the pressure's
gradient; by Betti's reciprocity it sinks by S times the traction's divergence.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial, reduce

import cv2
import mujoco
import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8

from touchgoal.control.tactile.gel import deform
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.sim_envs.scene.build import OBJECT_GROUP
from touchgoal.sim_envs.scene.contacts import PadContact
from touchgoal.sim_envs.scene.objects import Body, Material
from touchgoal.sim_envs.tactile.forces import ForceField, force_field, resample_to_image
from touchgoal.sim_envs.tactile.geometry import Grid, HeightField, add_mesh, add_primitive
from touchgoal.sim_envs.tactile.markers import GelMotion, draw, layer_compliance
from touchgoal.sim_envs.tactile.optics import render, render_untouched
from touchgoal.sim_envs.tactile.press import Press, press_until_balanced
from touchgoal.sim_envs.tactile.sensor_instance import SensorInstance
from touchgoal.sim_envs.tactile.texture import add_texture

_RIM = 0.3e-3  # m: how softly the relief ends where an object holds the surface


class ShearRelief:
    """Depth that a contact's shear, scaled as in `markers.GelMotion`, adds to a gel's surface."""

    def __init__(self, sensor: SensorModel, gel: Grid) -> None:
        """Prepare for forces on the gel's cells, two by two of `gel`."""
        self._stiffness, self._pitch = sensor.shear_stiffness, 2 * gel.pitch
        size = 2.2 * max(sensor.gel_size)  # m, padded: the Fourier transform wraps around
        self._n = 1 << int(np.ceil(np.log2(size / self._pitch)))
        self._kx = 2 * np.pi * np.fft.rfftfreq(self._n, self._pitch)[None]
        self._ky = 2 * np.pi * np.fft.fftfreq(self._n, self._pitch)[:, None]
        wave = np.hypot(self._kx, self._ky)
        along, across, self._squeeze = layer_compliance(sensor, wave)
        share = np.stack([self._kx + 0 * self._ky, self._ky + 0 * self._kx])
        self._give = across + (along - across) * (share / np.maximum(wave, 1e-3)) ** 2

    def __call__(
        self, field: ForceField, overlap: Float32[np.ndarray, "h w"], image: Grid
    ) -> Float32[np.ndarray, "h w"]:
        """Return the depth (m) to add to the surface; none where the object itself holds it.

        `overlap`: object's overlap with the undeformed gel, on the grid `image`.
        """
        relief = resample_to_image(self.depth(field), field, image)
        free = (overlap <= 0).astype(np.float32)
        return relief * cv2.GaussianBlur(free, (0, 0), _RIM / image.pitch)

    def depth(self, field: ForceField) -> Float[np.ndarray, "h w"]:
        """Return the depth (m) of the surface under the shear alone, on the field's cells."""
        h, w = field.normal.shape
        area, shape = self._pitch**2, (self._n, self._n)
        if not field.normal.any():
            return np.zeros((h, w))
        pressure = np.fft.rfft2(field.normal / area, shape)
        yielding = np.fft.irfft2(self._give * pressure, shape)[:, :h, :w]
        give = (yielding * field.normal).sum((1, 2))  # the patch's motion under unit traction
        scale = field.normal.sum() ** 2 / (self._stiffness * give)
        x, y = np.fft.rfft2(field.tangential * scale[:, None, None] / area, shape)
        spectrum = 1j * self._squeeze * (self._kx * x + self._ky * y)
        return np.fft.irfft2(spectrum, shape)[:h, :w]


_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
# Bodies are computed at half the image's resolution: between two of its rays a 20 mm ball deviates
# from a straight line by 0.09 um. Textures need the image's own, the force balance, over the whole
# gel, a quarter.
_TEXTURED, _SMOOTH, _COARSE = 1, 2, 4
AddGeom = Callable[[HeightField, float], None]  # raises a height field of a pitch (m) to a geom


@dataclass(frozen=True)
class TactileFrame:
    """One sensor reading."""

    image: UInt8[np.ndarray, "h w 3"]  # camera image, RGB
    # depth below rest, m, at the image's resolution or, under smooth bodies, at half of it
    surface: Float32[np.ndarray, "h2 w2"]
    overlap: Float32[np.ndarray, "h2 w2"]  # the object's depth in the undeformed gel, m; 0 beside
    field: ForceField | None  # forces over the whole gel; None where nothing touches

    @property
    def depth(self) -> Float32[np.ndarray, "h w"]:
        """Depth of the gel below its rest plane at the image's resolution, m."""
        h, w, _ = self.image.shape
        return cv2.resize(self.surface, (w, h), interpolation=cv2.INTER_LINEAR)

    @property
    def mask(self) -> Bool[np.ndarray, "h w"]:
        """Pixels at which an object touches the gel."""
        h, w, _ = self.image.shape
        return cv2.resize(self.overlap, (w, h), interpolation=cv2.INTER_LINEAR) > 0


class TactilePad:
    """One fingertip's sensor in a compiled model.

    The solver gives the pad's force and position. Geometry gives the contact's shape, in the frame
    of the sensor's case, so that shear moves the contact in the image. Stick and slip depend on
    earlier frames: read frames in order of time.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        side: str,
        sensor: SensorModel,
        instance: SensorInstance,
        bodies: list[Body],
        relief: bool = False,
    ) -> None:
        """`relief`: the surface rises and sinks where friction pulls along it."""
        self._model, self._sensor, self._instance = model, sensor, instance
        self._site = model.site(f"{side}_sensor").id
        self._materials = {int(model.body(b.name).id): b.kind.material for b in bodies}
        self._geoms = {body: _solid_geoms(model, body) for body in self._materials}
        self._meshes = {
            geom: _triangles(model, geom)
            for geoms in self._geoms.values()
            for geom in geoms
            if int(model.geom_type[geom]) == _MESH
        }
        rows, columns = sensor.image_shape
        pitch = instance.pixel_pitch
        self._grids = {k: Grid(rows // k, columns // k, k * pitch) for k in (_TEXTURED, _SMOOTH)}
        # Over the whole gel; its sizes are multiples of four.
        gel_columns, gel_rows = (4 * round(size / pitch / _COARSE / 4) for size in sensor.gel_size)
        self._gel_grid = Grid(gel_rows, gel_columns, pitch * _COARSE)
        self._field: ForceField | None = None
        self._motion = None
        if len(instance.markers):
            points = (instance.markers - np.array([columns - 1, rows - 1]) / 2) * pitch
            self._motion = GelMotion(sensor, self._gel_grid, points)
        self._relief = ShearRelief(sensor, self._gel_grid) if relief else None

    def sense(
        self, data: mujoco.MjData, contact: PadContact, rng: np.random.Generator
    ) -> TactileFrame:
        """Read the sensor in the present state; an untouched pad costs almost nothing."""
        touched = self._touched(contact)
        if not touched or contact.normal_force <= 0:
            return self._untouched(rng)
        placed = [self._placed(data, body) for body in touched]
        press = self._press(placed, contact, touched)
        textured = any(self._materials[body].is_textured for body in touched)
        grid = self._grids[_TEXTURED if textured else _SMOOTH]
        bodies = zip(touched, placed, strict=True)
        overlaps = (self._overlap(data, press, grid, *body) for body in bodies)
        overlap = reduce(np.maximum, overlaps)
        # The solver's coefficient: the object's, which has priority over the gel's.
        friction = max(float(self._model.geom_friction[geom, 0]) for geom in contact.geoms)
        self._field = force_field(press, self._field, contact, friction, self._sensor)
        surface = deform(overlap, grid.pitch, self._instance.calibration.blur_sigmas, textured)
        if self._relief is not None:
            surface += self._relief(self._field, overlap, grid)
        image = render(surface, self._instance, rng)
        if self._motion is not None:
            moved = self._motion(self._field) / np.float32(self._instance.pixel_pitch)
            draw(image, self._instance.markers + moved, self._instance.marker_radius)
        return TactileFrame(image, surface, overlap, self._field)

    def _untouched(self, rng: np.random.Generator) -> TactileFrame:
        self._field = None
        image = self._instance.with_dots(render_untouched(self._instance, rng))
        flat = np.zeros((self._grids[_SMOOTH].rows, self._grids[_SMOOTH].columns), np.float32)
        return TactileFrame(image, flat, flat, None)

    def _touched(self, contact: PadContact) -> list[int]:
        """Return bodies on the pad; the scene's own parts (table, case) leave no image."""
        bodies = {int(self._model.geom_bodyid[geom]) for geom in contact.geoms}
        return sorted(bodies & self._geoms.keys())

    def _modulus(self, material: Material) -> float:
        return 1 / (1 / self._sensor.foundation_modulus + 1 / material.foundation_modulus)

    def _press(self, placed: list[list[AddGeom]], contact: PadContact, touched: list[int]) -> Press:
        height = reduce(np.maximum, (_height(geoms, self._gel_grid) for geoms in placed))
        modulus = min(self._modulus(self._materials[body]) for body in touched)
        return press_until_balanced(height, self._gel_grid.pitch, contact, modulus, self._sensor)

    def _overlap(
        self, data: mujoco.MjData, press: Press, grid: Grid, body: int, geoms: list[AddGeom]
    ) -> HeightField:
        material, coarse = self._materials[body], self._grids[_SMOOTH]
        height = _height(geoms, coarse)
        press.push_in(height, coarse.pitch)
        if grid is not coarse:
            height = cv2.resize(height, (grid.columns, grid.rows), interpolation=cv2.INTER_LINEAR)
        position, rotation = self._pose(data, data.xpos[body], data.xmat[body])
        add_texture(height, grid.pitch, material, position - [0, 0, press.shift], rotation)
        cv2.threshold(height, 0, 0, cv2.THRESH_TOZERO, dst=height)
        height *= np.float32(self._modulus(material) / self._sensor.foundation_modulus)
        return height

    def _placed(self, data: mujoco.MjData, body: int) -> list[AddGeom]:
        """Return for each geom of a body what raises a height field of some pitch to it."""
        placed: list[AddGeom] = []
        for geom in self._geoms[body]:
            position, rotation = self._pose(data, data.geom_xpos[geom], data.geom_xmat[geom])
            if geom in self._meshes:
                vertices, faces = self._meshes[geom]
                shape = partial(add_mesh, vertices=vertices, faces=faces)
            else:
                kind, size = int(self._model.geom_type[geom]), self._model.geom_size[geom]
                shape = partial(add_primitive, kind=kind, size=size)
            placed.append(partial(shape, position=position, rotation=rotation))
        return placed

    def _pose(
        self, data: mujoco.MjData, position: Float[np.ndarray, "3"], matrix: Float[np.ndarray, "9"]
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
        R = data.site_xmat[self._site].reshape(3, 3)
        return (position - data.site_xpos[self._site]) @ R, R.T @ matrix.reshape(3, 3)


def _height(geoms: list[AddGeom], grid: Grid) -> HeightField:
    """Return one body's height field before it is pushed into the gel, m."""
    height = grid.empty()
    for add in geoms:
        add(height, grid.pitch)
    return height


def _solid_geoms(model: mujoco.MjModel, body: int) -> list[int]:
    first, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
    return [g for g in range(first, first + count) if model.geom_group[g] == OBJECT_GROUP]


def _triangles(
    model: mujoco.MjModel, geom: int
) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, "m 3"]]:
    """Return vertices and faces of a mesh geom, in its frame."""
    mesh = model.geom_dataid[geom]
    vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    vertices = model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]]
    return vertices, model.mesh_face[face : face + model.mesh_facenum[mesh]]
