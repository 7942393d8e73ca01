"""Recording of touches by a real wand, which a person holds, as the twin's are recorded."""

import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from touchgoal.control import features as ft
from touchgoal.control.arrays import Image
from touchgoal.control.cell.wand import Wand, WandConfig, connect_wand
from touchgoal.control.cell.wand_recorder import WandRecorder
from touchgoal.control.interfaces import DriverError
from touchgoal.control.tactile.image_guard import check_untouched
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.control.wand_touch import FORCE_RANGES, WandTouch, force_range
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.episodes.wand.episode import FPS, SET, Visit, wand_episode
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.interruption import stop_on_request

_POLL_INTERVAL = 0.004  # s between looks for a new image
_WIDTH = 100  # characters of the terminal's line


def record_real_touches(
    root: Path,
    config: WandConfig,
    name: str,
    descriptions: tuple[str, ...],
    count: int | None,
    new_gel: bool,
) -> EpisodeSet | None:
    """Record touches of one object until there are `count` of it, a device is lost for good, or Ctrl-C.

    Each touch is on disk before the next begins. Hints and warnings are printed.

    UserError: the folder holds other touches, or a device cannot be opened or is silent.

    Args:
        root: folder of the set; it may hold touches of the same wand.
        descriptions: how it feels, in words.
        count: touches of this object that the set shall hold; None: no end.
        new_gel: whether another gel is on the wand than at the last touch of the set.

    Returns:
        The set; None if it is still empty.
    """
    sensor = find_sensor(config.gel.sensor)
    writer = EpisodeWriter(root, fps=FPS)
    with closing(writer):
        origin = f"{sensor.name}, real"
        before = EpisodeSet(root) if len(writer) else None
        gel, number, first = _continued(before, origin, new_gel)
        counts = _counts(before, name)
        visit = Visit(origin, sensor.name, name, descriptions, gel, number)
        recorder = WandRecorder(sensor, first, counts)
        with closing(connect_wand(config)) as wand, stop_on_request() as stopped:
            check_untouched(wand.gel.read().image, sensor, "the image of the wand's gel")
            _Session(writer, visit, recorder, wand).run(stopped, count)
    return EpisodeSet(root) if len(writer) else None


class _Session:
    """One visit: feeds the recorder, writes its touches to the set, prints its hints."""

    def __init__(
        self, writer: EpisodeWriter, visit: Visit, recorder: WandRecorder, wand: Wand
    ) -> None:
        self._writer, self._visit, self._recorder, self._wand = writer, visit, recorder, wand
        self._line = _StatusLine()
        self._worn = ""  # kind of wear that was last printed

    def run(self, stopped: Callable[[], bool], count: int | None) -> None:
        """Record until there are `count` touches of this object, a device is lost, or Ctrl-C."""
        try:
            while not stopped() and (count is None or sum(self._recorder.counts) < count):
                self._step()
        except DriverError as error:
            self._line.say(f"ended: {error}")
        self._save(self._recorder.finish())

    def _step(self) -> None:
        if problem := self._wand.problem():
            self._save(self._recorder.drop(problem))
        elif (moment := self._wand.read()) is not None:
            made = self._recorder.update(moment)
            if isinstance(made, str):
                self._line.say(made)
            else:
                self._save(made)
            self._warn()
        self._line.show(self._recorder.hint, self._recorder.force)
        time.sleep(_POLL_INTERVAL)

    def _save(self, touch: WandTouch | None) -> None:
        if touch is None:
            return
        self._writer.append(wand_episode(touch, self._visit, self._recorder.gel_wear))
        self._line.say(f"recorded {sum(self._recorder.counts)}: {touch.load[-1]:.1f} N")

    def _warn(self) -> None:
        """Print the gel's wear, once for each kind."""
        wear = self._recorder.gel_wear
        kind = wear.kind if wear else ""
        if kind and kind != self._worn:
            self._line.say(f"{wear}; with a new one, start again with --new-gel")
        self._worn = kind


class _StatusLine:
    """A line that is overwritten on a terminal; in a pipe each new hint is a line."""

    def __init__(self) -> None:
        self._terminal, self._shown = sys.stdout.isatty(), ""

    def show(self, hint: str, force: float) -> None:
        if self._terminal:
            hint = f"{force:5.1f} N  {hint}"
        if hint != self._shown:
            self._shown = hint
            self._write(hint, end="" if self._terminal else "\n")

    def say(self, text: str) -> None:
        """Print a line that stays."""
        self._shown = ""
        self._write(text, end="\n")

    def _write(self, text: str, end: str) -> None:
        print(f"\r{text:<{_WIDTH}}" if self._terminal else text, end=end, flush=True)


def _continued(
    episodes: EpisodeSet | None, origin: str, new_gel: bool
) -> tuple[int, int, Image | None]:
    """Return the gel's number, the visit's, and the gel's first image if the set has one."""
    if episodes is None:
        return 0, 0, None
    meta = [episodes.meta(i) for i in range(len(episodes))]
    if (other := meta[0].get(SET)) != origin:
        raise UserError(
            f"{episodes.root} holds other touches ({other}), not {origin}: give another folder"
        )
    gels, visits = ([int(m[key]) for m in meta] for key in ("gel", "visit"))  # pyright: ignore[reportArgumentType]
    if new_gel:
        return gels[-1] + 1, max(visits) + 1, None
    first = episodes.read(gels.index(gels[-1]), [ft.TACTILE_LEFT], [0]).frames[ft.TACTILE_LEFT][0]
    return gels[-1], max(visits) + 1, first


def _counts(episodes: EpisodeSet | None, name: str) -> tuple[int, ...]:
    """Return how many touches of an object a set has in each range of force."""
    counts = [0] * len(FORCE_RANGES)
    for meta in [] if episodes is None else map(episodes.meta, range(len(episodes))):
        if meta["object"] == name:
            counts[force_range(float(meta["force"]))] += 1  # pyright: ignore[reportArgumentType]
    return tuple(counts)
