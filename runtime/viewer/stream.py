"""Stream of images and curves to the rerun viewer: to an .rrd file, or live to a viewer."""

import os
import sys
from collections.abc import Collection, Mapping
from contextlib import ExitStack
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
    """Recording of a control loop: `log` never waits, a thread compresses and writes.

    It is laid out by its first tick (`lay_out`).
    """

    def __init__(self, target: str) -> None:
        """Open an .rrd file, which is complete or absent, or a viewer ("live"), and start the thread.

        UserError as `load_rerun`, or the viewer does not start.
        """
        self._rerun = load_rerun(target)
        self._recording = self._rerun.RecordingStream("touchgoal")
        self._file = ExitStack()
        if target == LIVE:
            try:
                self._recording.spawn()
            except Exception as error:  # rerun's own classes differ by version
                raise UserError(f"--rerun live: the viewer does not start ({error})") from error
        else:
            self._recording.save(str(self._file.enter_context(atomic_write(Path(target)))))
        self._frames = self._dropped = 0  # ticks so far, and those that found the queue full
        self._queue: Queue[tuple[Any, ...] | None] = Queue(_WAITING)
        self._error: Exception | None = None
        self._thread = Thread(target=self._work, name="rerun", daemon=True)
        self._thread.start()

    def log(
        self,
        seconds: float,
        images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
        scalars: Mapping[str, float],
    ) -> None:
        """Hand over a tick: images "IMAGE", scalars "PLOT/CURVE"; arrays must not change later."""
        try:
            self._queue.put_nowait((self._frames, seconds, images, scalars))
        except Full:
            self._dropped += 1
        self._frames += 1

    def close(self) -> str:
        """Write what waits; return what went wrong, "" if nothing did.

        A failed recording must not hide the report of the run, so nothing is raised.
        """
        self._queue.put(None)
        self._thread.join()
        try:
            self._recording.disconnect()  # writes the rest
            self._file.close()
        except OSError as error:
            self._error = self._error or error
        if self._error is not None:
            return f"--rerun stopped recording: {self._error}"
        return f"--rerun left out {self._dropped} ticks" if self._dropped else ""

    def _work(self) -> None:
        laid_out = False
        while (tick := self._queue.get()) is not None:
            if self._error is not None:
                continue
            try:
                if not laid_out:
                    self._recording.send_blueprint(lay_out(*tick[2:]))
                    laid_out = True
                self._write(*tick)
            except Exception as error:  # `close` reports it: no arm stops for a viewer
                self._error = error

    def _write(
        self, frame: int, seconds: float, images: Mapping[str, Any], scalars: Mapping[str, float]
    ) -> None:
        self._recording.set_time("frame", sequence=frame)
        self._recording.set_time("time", duration=seconds)
        for path, image in images.items():
            encoded = self._rerun.Image(np.asarray(image)).compress(jpeg_quality=_JPEG_QUALITY)
            self._recording.log([path], encoded)
        for path, value in scalars.items():
            self._recording.log(path.split("/"), self._rerun.Scalars(float(value)))


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


_LEGEND = 5  # curves whose names fit into a plot's corner
# RGBA; Okabe and Ito, "Color universal design" (2008), without black
_COLORS = (0xE69F00FF, 0x56B4E9FF, 0x009E73FF, 0xF0E442FF, 0x0072B2FF, 0xD55E00FF, 0xCC79A7FF)


def lay_out(images: Collection[str], scalars: Collection[str]) -> Any:
    """Return a `rerun.blueprint.Blueprint`: images "IMAGE" beside plots of curves "PLOT/CURVE"."""
    import rerun.blueprint as views  # pyright: ignore[reportMissingImports]

    shown = [views.Spatial2DView(origin=_entity(path), name=path) for path in images]
    # pairs from the end: the fingertips come last, and stand side by side
    rows = [views.Horizontal(*shown[max(0, end - 2) : end]) for end in range(len(shown), 0, -2)]
    plots: dict[str, list[str]] = {}
    for path in scalars:
        plots.setdefault(path.rpartition("/")[0], []).append(path)
    curves = views.Vertical(*(_plot(plot, paths) for plot, paths in plots.items()))
    time = views.TimePanel(timeline="time", state="collapsed")
    both = views.Horizontal(views.Vertical(*reversed(rows)), curves, name="arm")
    return views.Blueprint(both, time, collapse_panels=True)


def _plot(plot: str, curves: list[str]) -> Any:
    import rerun  # pyright: ignore[reportMissingImports]
    import rerun.blueprint as views  # pyright: ignore[reportMissingImports]

    return views.TimeSeriesView(
        origin=_entity(plot),
        name=plot,
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
