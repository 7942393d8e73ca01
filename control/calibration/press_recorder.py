"""Recording of ball presses all over a gel, picked from a sensor's frames."""

from collections import deque
from collections.abc import Iterable

import cv2
import numpy as np
from jaxtyping import Int

from touchgoal.control.arrays import Image
from touchgoal.control.calibration.ball import find_circle
from touchgoal.control.calibration.press_set import PressSet
from touchgoal.control.interfaces import DriverError
from touchgoal.control.sensors.live_image import LiveImage
from touchgoal.control.tactile.background import Background, local_change
from touchgoal.control.tactile.contact import ContactDetector
from touchgoal.runtime.errors import UserError

GRID = 3, 4  # rows and columns of the map of presses, of an image that is wider than high
_SETTLING = 15  # frames without a change, 0.6 s of a 25 Hz sensor, before the first press
_STILL = 5  # frames in which a press must stand still
_SETTLED = 1.0  # counts of local change between the medians of the first and of the last five
_STEADY = 2.5  # counts of local change from frame to frame of a press in a person's hand, at most
_SMALLEST = 6.0  # px, radius of a contact that shows slopes
# Names of the map's rows, and of its columns, by their number.
_PLACES = {3: ("top", "middle", "bottom"), 4: ("top", "upper middle", "lower middle", "bottom")}
_SIDES = {
    3: ("left", "middle", "right"),
    4: ("left", "left of the middle", "right of the middle", "right"),
}


class PressRecorder:
    """Recorder of one image per press: the first in which the ball stands still.

    `shape` is that of the frames (rows, columns); `per_cell` is the number of presses wanted in each
    cell of the map.
    """

    def __init__(self, shape: tuple[int, int], per_cell: int = 2) -> None:
        self._shape, self._per_cell = shape, per_cell
        self.grid = GRID if shape[1] >= shape[0] else GRID[::-1]
        self.images: list[Image] = []
        self.circles: list[np.ndarray] = []  # as `find_circle` finds them, px
        self.hint = "leave the gel untouched"  # for the person who presses
        self._recent = deque[Image](maxlen=_SETTLING)
        self._detector: ContactDetector | None = None
        self._taken = False  # whether this contact is recorded

    @property
    def background(self) -> Image:
        """Current untouched gel; UserError before it has settled."""
        if self._detector is None:
            raise UserError(
                "the gel never stood still and untouched: begin with a second without touch"
            )
        return np.rint(self._detector.background.image).astype(np.uint8)

    @property
    def counts(self) -> Int[np.ndarray, "rows columns"]:
        """Number of presses in each cell of the map."""
        x, y, _ = np.reshape(self.circles, (-1, 3)).T
        height, width = self._shape
        return np.histogram2d(y, x, self.grid, [[0, height], [0, width]])[0].astype(int)

    @property
    def complete(self) -> bool:
        """Whether every cell has its presses."""
        return bool((self.counts >= self._per_cell).all())

    def presses(self, ball_radius: float, first: int = 0) -> PressSet:
        """Return the recorded presses of a ball (radius, m), numbered from `first`."""
        names = tuple(f"press_{first + i:03d}.png" for i in range(len(self.images)))
        images, circles = np.stack(self.images), np.stack(self.circles)
        return PressSet(self.background, images, circles, np.full(len(images), ball_radius), names)

    def update(self, frame: Image) -> bool:
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

    def draw_map(self, frame: Image) -> Image:
        """Draw the recorded circles and the count of each cell on a frame."""
        scale = max(1, round(640 / frame.shape[1]))
        size = frame.shape[1] * scale, frame.shape[0] * scale
        image = cv2.resize(frame, size, interpolation=cv2.INTER_NEAREST)
        rows, columns = self.grid
        for (row, column), count in np.ndenumerate(self.counts):
            left, top = column * size[0] // columns, row * size[1] // rows
            right, bottom = (column + 1) * size[0] // columns, (row + 1) * size[1] // rows
            colour = (0, 158, 115) if count >= self._per_cell else (213, 94, 0)
            cv2.rectangle(image, (left + 2, top + 2), (right - 3, bottom - 3), colour, 1)
            _write(image, f"{count}/{self._per_cell}", (left + 8, top + 20), colour)
        for x, y, radius in self.circles:
            centre = round((x + 0.5) * scale), round((y + 0.5) * scale)
            cv2.circle(image, centre, round(radius * scale), (255, 255, 255), 1, cv2.LINE_AA)
        _write(image, self.hint, (8, size[1] - 10), (255, 255, 255))
        return image

    def _settle(self) -> None:
        recent = np.stack(self._recent)
        if len(recent) < _SETTLING:
            return
        parts = recent[:_STILL], recent[-_STILL:]
        before, after = (np.median(part, 0).astype(np.float32) for part in parts)
        if float(local_change(after, before).max()) > _SETTLED:
            self.hint = "leave the gel untouched until it has settled"
            return
        middle = np.median(recent, 0).astype(np.uint8)
        self._detector = ContactDetector(Background(middle[None]))
        self.hint = f"press {self._where_next()}"

    def _record(self, frame: Image) -> bool:
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
            self.hint = "not recorded: the ball presses outside the image"
        else:
            self.images.append(frame)
            self.circles.append(np.array([x, y, radius]))
            self.hint = f"recorded {len(self.images)}: lift the ball"
            return True
        return False

    def _where_next(self) -> str:
        if self.complete:
            return "once more, or end with Ctrl-C"
        rows, columns = self.grid
        row, column = np.unravel_index(int(self.counts.argmin()), self.grid)
        return f"at the {_PLACES[rows][row]}, {_SIDES[columns][column]}"


def record_presses(
    frames: Iterable[Image], recorder: PressRecorder, live: LiveImage | None
) -> None:
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


def _write(image: Image, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
    (x, y), black = at, (0, 0, 0)
    cv2.rectangle(image, (x - 3, y - height - 4), (x + width + 3, y + 5), black, cv2.FILLED)
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)
