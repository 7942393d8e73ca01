"""Recording of touches that a person makes with a real wand, picked from its devices' readings.

Contact begins when load cell and gel both show it, and ends when either no longer does. The load cell's
load in free air is subtracted: the head's weight on it changes with the wand's tilt.
"""

from collections import deque

import numpy as np
from jaxtyping import Float

from touchgoal.control.arrays import Image
from touchgoal.control.cell.wand import WandReading
from touchgoal.control.tactile.background import Background, local_change
from touchgoal.control.tactile.contact import ContactDetector, threshold_for
from touchgoal.control.tactile.gel_wear import GelWear, find_wear
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.control.wand_touch import CLIP, FORCE_RANGES, MAX_FORCE, WandTouch, force_range

_CONTACT = 0.3  # N above the load in free air; an HX711's noise is 0.005
_LEAST_FORCE = 0.5  # N of a touch
_BEFORE = 25  # readings, 1 s of a Mini: then the wand is still centimetres from the object
_SETTLING = 12  # readings without a change, after a touch or at the start
_PART = 5  # first and last of them that are compared
_SETTLED = 1.5  # counts of local change between their medians; a compressed stream is never still
_LASTING = 10  # readings of disagreement between gel and load cell before the hint says so
# Share of the force on an untouched gel that each reading adds to the free-air load: the wand was
# tilted.
_TURNED = 0.02
_HELD = 5  # readings near the largest force
_NEAR = 0.1  # share below the largest force that counts as near
_LONGEST = 250  # readings of a touch


class WandRecorder:
    """Recorder of one touch after another; `hint` says what to do now.

    Attributes:
        hint: for the person who presses.
        force: on the gel, N; 0 in free air.
        counts: touches in each of the paper's ranges of force.
        gel_wear: wear of the gel when it was last seen untouched.
    """

    def __init__(
        self, sensor: SensorModel, first: Image | None = None, counts: tuple[int, ...] = (0, 0, 0)
    ) -> None:
        """`first`: first untouched image of this gel, None if new; `counts`: touches per range."""
        self.hint, self.force = "leave the gel untouched", 0.0
        self.counts = list(counts)
        self.gel_wear: GelWear | None = None
        self._sensor, self._first = sensor, first
        self._free: deque[WandReading] = deque(maxlen=_BEFORE)  # untouched, since the last touch
        self._detector: ContactDetector | None = None  # None until the gel has settled
        self._air = 0.0  # the load cell's force in free air, N
        self._press: list[tuple[Image, float]] = []
        self._disagreed = 0  # readings in a row at which gel and load cell disagree
        self._before: WandReading | None = None
        self._peak: WandReading | None = None
        self._made: WandTouch | None = None  # a finished touch, until the gel has been checked

    def update(self, reading: WandReading) -> WandTouch | str | None:
        """Process the next reading; return a touch when the gel has settled after it.

        A text says why a touch does not count.
        """
        self.force = reading.force - self._air
        if self._detector is None:
            return self._settle(reading)
        touching = self._detector.update(reading.image)
        if self._press:
            return self._follow(reading, touching)
        elif touching and self.force > _CONTACT:
            self._before, self._peak = self._free[0], reading
            self._press = [(reading.image, self.force)]
        elif touching or self.force > _CONTACT:
            self._disagree(touching)
        else:
            self._disagreed = 0
            self._free.append(reading)
            self._air = float(np.median([free.force for free in self._free]))
            self.hint = self._wanted()
        return None

    def _disagree(self, touching: bool) -> None:
        """Hint at the device that shows no touch, once the disagreement has lasted."""
        self._disagreed += 1
        if touching:
            advice = "press harder, or let go: the gel is touched, but the load cell reads nothing"
        else:
            advice = "press with the gel: the load cell reads a force, but the gel shows nothing"
            self._air += _TURNED * self.force
        if self._disagreed >= _LASTING:
            self.hint = advice

    def drop(self, hint: str) -> WandTouch | None:
        """Give up the touch in hand, because of a lost device; return a finished one, if any."""
        self.hint = hint
        self._begin_to_settle()
        return self._take()

    def finish(self) -> WandTouch | None:
        """End here; return the touch in hand as far as it has come, if it counts."""
        if self._press:
            self._end_press()
        return self.drop("ended")

    def _settle(self, reading: WandReading) -> WandTouch | None:
        self._free.append(reading)
        recent = list(self._free)[-_SETTLING:]
        if len(recent) < _SETTLING:
            return None
        images = np.stack([free.image for free in recent])
        parts = images[:_PART], images[-_PART:]
        start, end = (np.median(part, 0).astype(np.uint8) for part in parts)
        moved = float(local_change(end, start).max()) > _SETTLED
        if moved or np.ptp([free.force for free in recent]) > _CONTACT:
            self.hint = "leave the gel untouched and the wand still, until it has settled"
            return None
        middle = np.median(images, 0).astype(np.uint8)
        self._first = middle if self._first is None else self._first
        self.gel_wear = find_wear(middle, self._first, self._sensor)
        threshold = threshold_for(images, middle)
        self._detector = ContactDetector(Background(middle[None]), threshold)
        self._free = deque(recent, maxlen=_BEFORE)
        self._air = float(np.median([free.force for free in recent]))
        made, self.hint = self._take(), self._wanted()
        return made

    def _take(self) -> WandTouch | None:
        """Return the finished touch, if any, and count it."""
        made, self._made = self._made, None
        if made is not None:
            self.counts[force_range(float(made.load[-1]))] += 1
        return made

    def _follow(self, reading: WandReading, touching: bool) -> str | None:
        """Follow a touch from contact to the lift."""
        if not touching or self.force < _CONTACT / 2:
            return self._end_press()
        largest = max(force for _, force in self._press)
        if len(self._press) < _LONGEST:
            self._press.append((reading.image, self.force))
            if self.force > largest:
                self._peak, largest = reading, self.force
        if largest > MAX_FORCE:
            self.hint = f"too hard, lift: {MAX_FORCE:g} N at most"
        else:
            self.hint = "lift" if self._held() else "hold"
        return None

    def _held(self) -> bool:
        forces = [force for _, force in self._press]
        return sum(force > (1 - _NEAR) * max(forces) for force in forces) >= _HELD

    def _end_press(self) -> str | None:
        """Make a touch of what was pressed, or return why it does not count."""
        assert self._before is not None and self._peak is not None
        forces = np.array([force for _, force in self._press])
        rise = int(forces.argmax()) + 1
        wrong = None
        if forces.max() > MAX_FORCE:
            wrong = "not recorded, too hard: press less"
        elif forces.max() < _LEAST_FORCE:
            wrong = "not recorded, too light: press harder"
        elif rise < CLIP - 1 or not self._held():
            wrong = "not recorded, too quick: press slowly, and hold before you lift"
        else:
            chosen = evenly_loaded(forces[:rise], CLIP - 1)
            clip = [self._before.image, *(self._press[i][0] for i in chosen)]
            load = np.concatenate([[0.0], forces[chosen]]).astype(np.float32)
            before, views = self._before.views, self._peak.views
            self._made = WandTouch(before, views, np.stack(clip), load)
        self.hint = "let the gel settle"
        self._begin_to_settle()
        return wrong

    def _begin_to_settle(self) -> None:
        self._press, self._detector, self._before, self._peak = [], None, None, None
        self._free.clear()

    def _wanted(self) -> str:
        """Name the force range with the fewest touches."""
        low, high = FORCE_RANGES[int(np.argmin(self.counts))]
        done = ", ".join(
            f"{n} of {a:g}-{b:g} N" for n, (a, b) in zip(self.counts, FORCE_RANGES, strict=True)
        )
        return f"press with {low:g} to {high:g} N (recorded: {done})"


def evenly_loaded(forces: Float[np.ndarray, " n"], count: int) -> list[int]:
    """Return the indices of `count` readings, in order, with forces rising evenly to the last."""
    chosen: list[int] = []
    for k in range(1, count):
        first = chosen[-1] + 1 if chosen else 0
        last = len(forces) - (count - k)  # leaves one reading for each later choice
        aim = forces[-1] * k / count
        chosen.append(first + int(np.abs(forces[first:last] - aim).argmin()))
    return [*chosen, len(forces) - 1]
