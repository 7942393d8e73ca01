"""Rise and fall of a gel's surface where friction pulls along it: the trace of shear without dots.

The gel is the layer of `markers.layer_compliance`: a load squeezes the surface aside by minus S
times the pressure's gradient; by Betti's reciprocity it sinks by S times the traction's divergence.
"""

import cv2
import numpy as np
from jaxtyping import Float, Float32

from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.sim_envs.tactile.forces import ForceField, resample_to_image
from touchgoal.sim_envs.tactile.geometry import Grid
from touchgoal.sim_envs.tactile.markers import layer_compliance

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
