"""Recording of ball presses all over a gel, picked from a sensor's frames."""

from collections import deque
from collections.abc import Iterable

import cv2
import numpy as np
from jaxtyping import Int, UInt8

from touchgoal.control.calibration.ball import find_circle
from touchgoal.control.calibration.press_set import PressSet
from touchgoal.control.interfaces import DriverError
from touchgoal.control.sensors.live_picture import LivePicture
from touchgoal.control.tactile.background import Background, local_change
from touchgoal.control.tactile.contact import ContactDetector
from touchgoal.runtime.errors import UserError

GRID = 3, 4
"""Rows and columns of the map of presses, of a picture that is wider than high."""
_SETTLING = 15  # frames without a change, 0.6 s of a 25 Hz sensor, before the first press
_STILL = 5  # frames in which a press must stand still
_SETTLED = 1.0  # counts of local change between the medians of the first and of the last five
_STEADY = 2.5  # counts of local change from frame to frame of a press in a person's hand, at most
_SMALLEST = 6.0  # px, radius of a contact that shows slopes
_PLACES = "top", "upper middle", "lower middle", "bottom"
_SIDES = "left", "left of the middle", "right of the middle", "right"

Frame = UInt8[np.ndarray, "h w 3"]


class PressRecorder:
    """Recorder of one picture of every press: the first in which it stands still.

    Args:
        shape: rows and columns of a frame.
        a_cell: presses wanted in each cell of the map.

    Attributes:
        images, circles: of the recorded presses; circles as `find_circle` finds them, px.
        hint: instruction for the person who presses.
    """

    def __init__(self, shape: tuple[int, int], a_cell: int = 2) -> None:
        self._shape, self._a_cell = shape, a_cell
        self.grid = GRID if shape[1] >= shape[0] else GRID[::-1]
        self.images: list[Frame] = []
        self.circles: list[np.ndarray] = []
        self.hint = "leave the gel untouched"
        self._recent = deque[Frame](maxlen=_SETTLING)
        self._detector: ContactDetector | None = None
        self._taken = False  # of this contact

    @property
    def background(self) -> Frame:
        """Current untouched gel; UserError before it has settled."""
        if self._detector is None:
            raise UserError(
                "the gel never stood still and untouched: begin with a second without touch"
            )
        return np.rint(self._detector.background.image).astype(np.uint8)

    @property
    def counts(self) -> Int[np.ndarray, "rows columns"]:
        """Number of presses in each cell of the map."""
        counts = np.zeros(self.grid, int)
        for circle in self.circles:
            counts[self._cell(circle)] += 1
        return counts

    @property
    def complete(self) -> bool:
        """Whether every cell has its presses."""
        return bool((self.counts >= self._a_cell).all())

    def presses(self, ball_radius: float, first: int = 0) -> PressSet:
        """Return the recorded presses.

        Args:
            ball_radius: m.
            first: number of the first picture.
        """
        names = tuple(f"press_{first + i:03d}.png" for i in range(len(self.images)))
        balls = np.full(len(self.images), ball_radius)
        return PressSet(
            self.background, np.stack(self.images), np.stack(self.circles), balls, names
        )

    def update(self, frame: Frame) -> bool:
        """Process the next frame and return whether it is recorded."""
        self._recent.append(frame)
        if self._detector is None:
            self._settle()
            return False
        if not self._detector.update(frame):
            self._taken = False
            self.hint = f"press {self._where_next()}"
            return False
        if self._taken:
            return False
        recent = list(self._recent)[-_STILL:]
        steady = max(_STEADY, self._detector.threshold)  # a compressed stream is never quite still
        if float(local_change(recent[0], frame).max()) > steady:
            self.hint = "hold still"
            return False
        self._taken = True
        return self._record(frame)

    def draw_map(self, frame: Frame) -> Frame:
        """Draw the recorded circles and the count of each cell on a frame."""
        scale = max(1, round(640 / frame.shape[1]))
        size = frame.shape[1] * scale, frame.shape[0] * scale
        picture = cv2.resize(frame, size, interpolation=cv2.INTER_NEAREST)
        rows, columns = self.grid
        for (row, column), count in np.ndenumerate(self.counts):
            left, top = column * size[0] // columns, row * size[1] // rows
            right, bottom = (column + 1) * size[0] // columns, (row + 1) * size[1] // rows
            colour = (0, 158, 115) if count >= self._a_cell else (213, 94, 0)
            cv2.rectangle(picture, (left + 2, top + 2), (right - 3, bottom - 3), colour, 1)
            _write(picture, f"{count}/{self._a_cell}", (left + 8, top + 20), colour)
        for x, y, radius in self.circles:
            centre = round((x + 0.5) * scale), round((y + 0.5) * scale)
            cv2.circle(picture, centre, round(radius * scale), (255, 255, 255), 1, cv2.LINE_AA)
        _write(picture, self.hint, (8, size[1] - 10), (255, 255, 255))
        return picture

    def _settle(self) -> None:
        recent = np.stack(self._recent)
        if len(recent) < _SETTLING:
            return
        before, after = (np.median(part, 0) for part in (recent[:_STILL], recent[-_STILL:]))
        if (
            float(local_change(after.astype(np.float32), before.astype(np.float32)).max())
            > _SETTLED
        ):
            self.hint = "leave the gel untouched until it has settled"
            return
        middle = np.median(recent, 0).astype(np.uint8)
        self._detector = ContactDetector(Background(middle[None]))
        self.hint = f"press {self._where_next()}"

    def _record(self, frame: Frame) -> bool:
        """Record a press and return whether it is fit; the hint says why not."""
        try:
            x, y, radius = find_circle(frame, self.background)
        except UserError as error:
            self.hint = f"not recorded: {str(error).split(':')[0]}"
            return False
        h, w = self._shape
        if radius < _SMALLEST:
            self.hint = "not recorded, too light: press harder"
        elif not (0 <= x < w and 0 <= y < h):
            self.hint = "not recorded: the ball presses outside the picture"
        else:
            self.images.append(frame)
            self.circles.append(np.array([x, y, radius]))
            self.hint = f"recorded {len(self.images)}: lift the ball"
            return True
        return False

    def _cell(self, circle: np.ndarray) -> tuple[int, int]:
        (h, w), (rows, columns) = self._shape, self.grid
        row, column = int(circle[1] / h * rows), int(circle[0] / w * columns)
        return min(row, rows - 1), min(column, columns - 1)

    def _where_next(self) -> str:
        if self.complete:
            return "once more, or end with Ctrl-C"
        rows, columns = self.grid
        row, column = np.unravel_index(int(self.counts.argmin()), self.grid)
        side, place = _name(_SIDES, int(column), columns), _name(_PLACES, int(row), rows)
        return f"at the {place}, {side}"


def record(frames: Iterable[Frame], recorder: PressRecorder, live: LivePicture | None) -> None:
    """Feed the recorder until its map is full, the frames end, the sensor is lost, or Ctrl-C."""
    hint = ""
    try:
        for frame in frames:
            recorder.update(frame)
            if live is not None:
                live.show(recorder.draw_map(frame))
                if recorder.hint != hint:
                    hint = recorder.hint
                    print(hint, flush=True)
            if recorder.complete:
                return
    except KeyboardInterrupt:
        print("ended")
    except DriverError as error:  # the presses recorded so far are written
        print(f"ended: {error}")


def _name(names: tuple[str, ...], index: int, count: int) -> str:
    if count == 3:
        return (names[0], "middle", names[-1])[index]
    return names[index]


def _write(picture: Frame, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
    (x, y), black = at, (0, 0, 0)
    cv2.rectangle(picture, (x - 3, y - height - 4), (x + width + 3, y + 5), black, cv2.FILLED)
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)
