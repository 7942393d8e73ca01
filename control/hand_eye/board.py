"""A ChArUco board: a chessboard with a marker in each white square, found also where partly hidden."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image as PILImage

from touchgoal.control.arrays import Image
from touchgoal.runtime.atomic_write import atomic_write

_DICTIONARY = cv2.aruco.DICT_4X4_50
_MARKER_SHARE = 0.75  # side of a marker as a share of its square's
_LEAST_CORNERS = 8  # in a view; fewer say little about its pose
_DPI = 300
_MARGIN = 0.01  # m of white around the printed board


@dataclass(frozen=True)
class BoardView:
    """Inner corners of a board that a camera sees."""

    points: Float[np.ndarray, "k 3"]  # on the board, m: origin in a corner, z = 0
    pixels: Float[np.ndarray, "k 2"]  # in the image: x, y, px
    old_pattern: bool = False  # drawn as before OpenCV 4.6, which begins with a white square


@dataclass(frozen=True)
class Board:
    """A board of `columns` x `rows` squares with sides of `square` m."""

    columns: int
    rows: int
    square: float

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, m."""
        return self.columns * self.square, self.rows * self.square

    def find(self, image: Image) -> BoardView | None:
        """Return the corners in an RGB image, by the pattern that has more; None if it shows too few."""
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        found = [view for old in (False, True) if (view := self._find(grey, old))]
        return max(found, key=lambda view: len(view.points), default=None)

    def _find(self, grey: UInt8[np.ndarray, "h w"], old_pattern: bool) -> BoardView | None:
        board = self._board(old_pattern)
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
        if ids is None or len(ids) < _LEAST_CORNERS:
            return None
        corners_on_board = np.asarray(board.getChessboardCorners(), np.float64)
        points = corners_on_board[np.asarray(ids, np.intp).ravel()]
        if np.linalg.matrix_rank(points - points.mean(axis=0)) < 2:  # all on one line
            return None
        return BoardView(points, np.reshape(corners, (-1, 2)).astype(np.float64), old_pattern)

    def draw(self, pixels_per_metre: float) -> UInt8[np.ndarray, "h w"]:
        """Return the board without a margin, grey values."""
        width, height = (round(side * pixels_per_metre) for side in self.size)
        return np.asarray(self._board(old_pattern=False).generateImage((width, height)))

    def print_to(self, path: Path) -> None:
        """Write a PNG that prints at true scale, with the length to measure on paper below it."""
        per_metre = _DPI / 0.0254
        margin = round(_MARGIN * per_metre)
        page = np.pad(
            self.draw(per_metre),
            ((margin, 2 * margin), (margin, margin)),
            "constant",
            constant_values=255,
        )
        width, height = (1e3 * side for side in self.size)
        text = f"{self.columns} x {self.rows} squares; print at 100 %: {width:g} mm x {height:g} mm"
        place = (margin, page.shape[0] - margin)
        cv2.putText(page, text, place, cv2.FONT_HERSHEY_SIMPLEX, 1.6, 0, 3, cv2.LINE_AA)
        with atomic_write(path) as unfinished:
            PILImage.fromarray(page).save(unfinished, format="PNG", dpi=(_DPI, _DPI))

    def _board(self, old_pattern: bool) -> "cv2.aruco.CharucoBoard":
        dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARY)
        size, marker = (self.columns, self.rows), _MARKER_SHARE * self.square
        board = cv2.aruco.CharucoBoard(size, self.square, marker, dictionary)
        board.setLegacyPattern(old_pattern)
        return board
