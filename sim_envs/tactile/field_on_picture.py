"""Fields on a gel's cells, resampled onto the image: the gel moves, the image does not."""

import cv2
import numpy as np
from jaxtyping import Float, Float32

from touchgoal.sim_envs.tactile.forces import ForceField
from touchgoal.sim_envs.tactile.geometry import Grid

CELLS = 24
"""Rows and columns of a picture's tractions."""
_FINE = 4  # samples along each side of such a cell


def over_picture(
    values: Float[np.ndarray, "h w"], field: ForceField, picture: Grid
) -> Float32[np.ndarray, "h2 w2"]:
    """Interpolate values on a field's cells onto a grid centred on the image; 0 beyond the gel."""
    cells = field.pitch / picture.pitch  # image cells per gel cell
    middle = np.array(values.shape[::-1]) / 2 - 0.5 - np.array(field.displacement[:2]) / field.pitch
    shift = middle - (np.array([picture.columns, picture.rows]) / 2 - 0.5) / cells
    to_cells = np.column_stack([np.eye(2) / cells, shift])
    size = picture.columns, picture.rows
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(values.astype(np.float32), to_cells, size, flags=flags)


def tractions(
    field: ForceField | None, shape: tuple[int, int], pitch: float
) -> Float32[np.ndarray, "3 24 24"]:
    """Return shear along x and y and pressure over an image, kPa, averaged over 24 x 24 cells.

    Args:
        field: the contact's forces; None without contact.
        shape: rows and columns of the picture.
        pitch: m per pixel.
    """
    if field is None:
        return np.zeros((3, CELLS, CELLS), np.float32)
    step = max(shape) * pitch / (CELLS * _FINE)
    fine = Grid(round(shape[0] * pitch / step), round(shape[1] * pitch / step), step)
    stress = np.stack([*field.tangential, field.normal]) / (1e3 * field.pitch**2)
    planes = (over_picture(plane, field, fine) for plane in stress)
    size = CELLS, CELLS
    return np.stack([cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in planes])
