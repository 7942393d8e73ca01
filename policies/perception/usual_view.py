"""A camera image as the training's camera would see it, from where a calibrated camera stands.

Exact for another orientation or lens; of another place, for points at one height over the table.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from touchgoal.sim_envs.config import CameraPlacement

_HEIGHT = 0.02  # m over the table, about the middle of the objects
_MARGIN = 0.04  # of the image's height, about the radius of an object


@dataclass(frozen=True)
class UsualView:
    """From one camera's images to another's."""

    usual: CameraPlacement  # of the training
    here: CameraPlacement
    size: tuple[int, int]  # rows and columns of the usual images, px

    @property
    def shift(self) -> Float[np.ndarray, "3"]:
        """From the usual camera to the one here, m, base frame."""
        return np.subtract(self.here[:3], self.usual[:3])

    def __call__(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "y x 3"]:
        """Return the usual camera's image; what the camera here does not see is its nearest pixel."""
        if self.here == self.usual and image.shape[:2] == self.size:
            return image
        homography = self._to_here(*image.shape[:2])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpPerspective(
            image, homography, self.size[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE
        )

    def seen(
        self, place: Float[np.ndarray, "2"], image: UInt8[np.ndarray, "h w 3"]
    ) -> Float[np.ndarray, "2"]:
        """Return the row and column (px) in the usual image of a place in the camera's own image."""
        inverse = np.linalg.inv(self._to_here(*image.shape[:2]))
        column, row, scale = inverse @ np.array([place[1] - 0.5, place[0] - 0.5, 1.0])
        return np.array([row, column]) / scale + 0.5

    def shows(self, seen: Float[np.ndarray, "2"], image: UInt8[np.ndarray, "h w 3"]) -> bool:
        """Return whether the camera's own image shows what is around a place of the usual image, px."""
        rows, columns = image.shape[:2]
        column, row, scale = self._to_here(rows, columns) @ np.array([seen[1], seen[0], 1.0])
        margin = _MARGIN * rows
        inside = margin < row / scale < rows - margin
        return bool(scale > 0 and inside and margin < column / scale < columns - margin)

    def place(self, seen: Float[np.ndarray, "2"], height: float) -> Float[np.ndarray, "2"]:
        """Return where (x, y, m, base frame) a point seen at a row and column is, at a height (m).

        Row and column are px of the usual image, whose first pixel's centre is at 0.5.
        """
        row, column = seen - 0.5
        on_plane = self._to_table @ np.array([column, row, 1.0])
        # The ray from the camera here through the point of the plane, at this height.
        share = (self.here[2] - height) / (self.here[2] - _HEIGHT)
        eye = np.array(self.here[:2])
        return eye + share * (on_plane[:2] / on_plane[2] - eye)

    def _to_here(self, rows: int, columns: int) -> Float[np.ndarray, "3 3"]:
        """Return the homography from the usual image to the camera's own, of pixel centres."""
        return _from_table(self.here, rows, columns) @ self._to_table

    @property
    def _to_table(self) -> Float[np.ndarray, "3 3"]:
        return np.linalg.inv(_from_table(self.usual, *self.size))


def _from_table(placement: CameraPlacement, rows: int, columns: int) -> Float[np.ndarray, "3 3"]:
    """Return the homography from (x, y, m) at the height above to (column, row) of pixel centres."""
    *place, _, _, _, _, fovy = placement
    focal = rows / 2 / np.tan(np.radians(fovy) / 2)  # px
    camera = np.array([[focal, 0, (columns - 1) / 2], [0, focal, (rows - 1) / 2], [0, 0, 1]])
    from_base = Rotation.from_quat(placement[3:7], scalar_first=True).as_matrix().T
    offset = from_base @ (np.array([0.0, 0.0, _HEIGHT]) - place)
    return camera @ np.column_stack([from_base[:, :2], offset])
