"""Stream of images and curves to the rerun viewer: to an .rrd file, or live to a viewer."""

import os
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from itertools import cycle
from pathlib import Path
from queue import Full, Queue
from threading import Thread
from typing import Any

import numpy as np
from jaxtyping import UInt8

from touchgoal.runtime.atomic_write import atomic_write
from touchgoal.runtime.errors import UserError, install_extra

LIVE = "live"
_JPEG_QUALITY = 90
_WAITING = 60  # ticks that may wait for the background thread, 3 s at 20 Hz


class RerunStream:
    """An open recording, laid out by the paths that are logged (`lay_out`).

    Each tick is logged on the timelines "frame" and, where it is known, "time".
    """

    def __init__(self, rerun: Any, recording: Any) -> None:
        """Log to that recording of the module rerun."""
        self._rerun, self._recording = rerun, recording
        # paths so far, in order
        self._images: dict[str, None] = {}
        self._scalars: dict[str, None] = {}

    def show(self, images: Iterable[str], scalars: Iterable[str], timeline: str) -> None:
        """Give these paths their views, as `lay_out`.

        `log` does so when a path first appears, and each time sends the whole layout again: where there
        are many trajectories, name all paths beforehand.
        """
        self._images |= dict.fromkeys(images)
        self._scalars |= dict.fromkeys(scalars)
        self._recording.send_blueprint(lay_out(self._images, self._scalars, timeline))

    def log(
        self,
        frame: int,
        seconds: float | None,
        images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
        scalars: Mapping[str, float],
    ) -> None:
        """Log one tick: images "TRAJECTORY/IMAGE", scalars "TRAJECTORY/PLOT/CURVE"; `seconds` if known."""
        if not (images.keys() <= self._images.keys() and scalars.keys() <= self._scalars.keys()):
            self.show(images, scalars, "frame" if seconds is None else "time")
        self._recording.set_time("frame", sequence=frame)
        if seconds is not None:
            self._recording.set_time("time", duration=seconds)
        for path, image in images.items():
            encoded = self._rerun.Image(np.asarray(image)).compress(jpeg_quality=_JPEG_QUALITY)
            self._recording.log(path.split("/"), encoded)
        for path, value in scalars.items():
            self._recording.log(path.split("/"), self._rerun.Scalars(float(value)))


class BackgroundStream:
    """A stream for a control loop: `log` never waits, a thread compresses and writes."""

    def __init__(self, target: str) -> None:
        """Open it as `open_rerun` and start the thread."""
        self._opened = ExitStack()
        self._stream = self._opened.enter_context(open_rerun(target))
        self._dropped = 0  # ticks that found the queue full
        self._queue: Queue[tuple[Any, ...] | None] = Queue(_WAITING)
        self._error: Exception | None = None
        self._thread = Thread(target=self._work, name="rerun", daemon=True)
        self._thread.start()

    def log(self, *tick: Any) -> None:
        """Hand over a tick, as `RerunStream.log`; its arrays must not change later."""
        try:
            self._queue.put_nowait(tick)
        except Full:
            self._dropped += 1

    def close(self) -> str:
        """Write what waits; return what went wrong, "" if nothing did.

        A failed recording must not hide the report of the run, so nothing is raised.
        """
        self._queue.put(None)
        self._thread.join()
        try:
            self._opened.close()
        except OSError as error:
            self._error = self._error or error
        if self._error is not None:
            return f"--rerun stopped recording: {self._error}"
        return f"--rerun left out {self._dropped} ticks" if self._dropped else ""

    def _work(self) -> None:
        while (tick := self._queue.get()) is not None:
            if self._error is None:
                try:
                    self._stream.log(*tick)
                except Exception as error:  # `close` reports it: no arm stops for a viewer
                    self._error = error


def load_rerun(target: str) -> Any:
    """Import rerun; UserError if it is missing, or the target neither a file nor a viewer on a screen."""
    if target != LIVE and Path(target).suffix != ".rrd":
        raise UserError(f"--rerun takes {LIVE} or a file that ends in .rrd, not {target}")
    try:
        import rerun  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise UserError(f"--rerun needs rerun-sdk: {install_extra('viz')}") from error
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if target == LIVE and sys.platform == "linux" and not screen:
        raise UserError("--rerun live needs a screen: give a file, --rerun FILE.rrd")
    return rerun


@contextmanager
def open_rerun(target: str) -> Iterator[RerunStream]:
    """Open a stream to an .rrd file, which is complete or absent, or to a viewer ("live").

    UserError as `load_rerun`, or the viewer does not start.
    """
    rerun = load_rerun(target)
    recording = rerun.RecordingStream("touchgoal")
    if target == LIVE:
        try:
            recording.spawn()
        except Exception as error:  # rerun's own classes differ by version
            raise UserError(f"--rerun live: the viewer does not start ({error})") from error
        try:
            yield RerunStream(rerun, recording)
        finally:
            recording.disconnect()
        return
    with atomic_write(Path(target)) as unfinished:
        recording.save(str(unfinished))
        yield RerunStream(rerun, recording)
        recording.disconnect()  # writes the rest


_LEGEND = 5  # curves whose names fit into a plot's corner
# RGBA; Okabe and Ito, "Color universal design" (2008), without black
_COLORS = (0xE69F00FF, 0x56B4E9FF, 0x009E73FF, 0xF0E442FF, 0x0072B2FF, 0xD55E00FF, 0xCC79A7FF)


def lay_out(images: Collection[str], scalars: Collection[str], timeline: str) -> Any:
    """Return a `rerun.blueprint.Blueprint` with a tab for each trajectory.

    Args:
        images: paths "TRAJECTORY/IMAGE".
        scalars: paths "TRAJECTORY/PLOT/CURVE".
        timeline: name of the timeline that the viewer moves along.
    """
    import rerun.blueprint as views  # pyright: ignore[reportMissingImports]

    names = dict.fromkeys(path.split("/")[0] for path in (*images, *scalars))
    tabs = [
        _tab(name, *([p for p in paths if p.startswith(f"{name}/")] for paths in (images, scalars)))
        for name in names
    ]
    time = views.TimePanel(timeline=timeline, state="collapsed")
    return views.Blueprint(views.Tabs(*tabs), time, collapse_panels=True)


def _tab(name: str, images: list[str], scalars: list[str]) -> Any:
    import rerun.blueprint as views  # pyright: ignore[reportMissingImports]

    shown = [views.Spatial2DView(origin=_entity(p), name=p.rpartition("/")[2]) for p in images]
    # pairs from the end: the fingertips come last, and stand side by side
    rows = [views.Horizontal(*shown[max(0, end - 2) : end]) for end in range(len(shown), 0, -2)]
    plots: dict[str, list[str]] = {}
    for path in scalars:
        plots.setdefault(path.rpartition("/")[0], []).append(path)
    curves = views.Vertical(*(_plot(plot, paths) for plot, paths in plots.items()))
    return views.Horizontal(views.Vertical(*reversed(rows)), curves, name=name)


def _plot(plot: str, curves: list[str]) -> Any:
    import rerun  # pyright: ignore[reportMissingImports]
    import rerun.blueprint as views  # pyright: ignore[reportMissingImports]

    return views.TimeSeriesView(
        origin=_entity(plot),
        name=plot.rpartition("/")[2],
        overrides={
            _entity(curve): rerun.SeriesLines.from_fields(colors=color)
            for curve, color in zip(curves, cycle(_COLORS), strict=False)
        },
        axis_x=views.TimeAxis(link=views.components.LinkAxis.LinkToGlobal),
        plot_legend=views.PlotLegend(visible=1 < len(curves) <= _LEGEND),
    )


def _entity(path: str) -> str:
    import rerun  # pyright: ignore[reportMissingImports]

    return "/" + rerun.new_entity_path(path.split("/"))
