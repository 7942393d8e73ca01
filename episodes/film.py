"""Films of simulated episodes: images, a curve beside them, a caption below."""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import BboxBase

from touchgoal.control.features import TRUTH_PROGRESS
from touchgoal.episodes.media import write_video
from touchgoal.episodes.schema import Episode
from touchgoal.sim_envs.scene.filming import TICKS_PER_IMAGE

_BLUE = "#0072B2"
_DPI = 100
_PANEL = 320  # px, width of the curves
_CAPTION = 24  # px, height of the caption


def write_film(
    path: Path,
    images: UInt8[np.ndarray, "n h w 3"],
    episode: Episode,
    control_hz: int,
    curves: Mapping[str, Float[np.ndarray, " ticks"]] | None = None,
    label: str = "",
    colors: Mapping[str, str] | None = None,
) -> None:
    """Write an MP4 that plays in real time: images, curves up to now, object, outcome, seed, time.

    Args:
        images: of `record_with_film`, one every `TICKS_PER_IMAGE` ticks.
        control_hz: ticks per second.
        curves: values at each tick, which may end before the episode: so does the film; default: the
            simulator's progress.
        label: axis label of the curves.
        colors: of the curves, by their names; default: blue.
    """
    if curves is None:
        curves, label = {"progress": episode.frames[TRUTH_PROGRESS][:, 0]}, "progress"
    ticks = max(map(len, curves.values())) - 1
    panel, box = _draw_panel(images.shape[1], curves, control_hz, label, colors or {})
    frames = []
    for k, image in enumerate(images[: ticks // TICKS_PER_IMAGE + 1]):
        t = k * TICKS_PER_IMAGE / control_hz
        beside = np.hstack([image, _up_to(panel, box, k * TICKS_PER_IMAGE / ticks)])
        caption = _caption(beside.shape[1], caption_of(episode), f"{t:.1f} s")
        frames.append(np.vstack([beside, caption]))
    write_video(path, np.stack(frames), control_hz / TICKS_PER_IMAGE)


def caption_of(episode: Episode) -> str:
    """Return object or wire, outcome and seed: "glass_ball: success, seed 7"."""
    meta = episode.meta
    name = meta.get("object") or meta.get("wire") or meta.get("task", "episode")
    outcome = "success" if meta.get("success") else meta.get("outcome", "outcome unknown")
    return f"{name}: {outcome}, seed {meta.get('seed', 'unknown')}"


def _draw_panel(
    height: int, curves: Mapping[str, np.ndarray], hz: int, label: str, colors: Mapping[str, str]
) -> tuple[np.ndarray, BboxBase]:
    """Return an image of all curves, and the box of its axes (px)."""
    figure = Figure(figsize=(_PANEL / _DPI, height / _DPI), dpi=_DPI)
    axes = figure.add_axes((0.16, 0.17, 0.8, 0.66))
    for name, values in curves.items():
        time = np.arange(len(values)) / hz
        axes.plot(time, values, color=colors.get(name, _BLUE), label=name, lw=1.5)
    axes.margins(x=0)
    axes.set_xlabel("time (s)", fontsize=7, labelpad=1)
    axes.set_ylabel(label, fontsize=7, labelpad=2)
    axes.tick_params(labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="upper center", ncols=4, fontsize=7, frameon=False, handlelength=1.2)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3], axes.get_window_extent()


def _up_to(panel: np.ndarray, box: BboxBase, share: float) -> np.ndarray:
    """Return the panel with a line at the present (share of the time axis) and a faded future."""
    shown = panel.copy()
    column = round(box.x0 + share * (box.x1 - box.x0))
    top, bottom = len(panel) - round(box.y1), len(panel) - round(box.y0) - 2
    future = shown[top:bottom, column:]
    future[:] = 255 - (255 - future) // 5
    shown[top:bottom, column : column + 2] = 90
    return shown


def _caption(width: int, left: str, right: str) -> np.ndarray:
    strip = np.zeros((_CAPTION, width, 3), np.uint8)
    font, white = (cv2.FONT_HERSHEY_SIMPLEX, 0.45), (255, 255, 255)
    cv2.putText(strip, left, (6, 16), *font, white, 1, cv2.LINE_AA)
    (wide, _), _ = cv2.getTextSize(right, *font, 1)
    cv2.putText(strip, right, (width - 6 - wide, 16), *font, white, 1, cv2.LINE_AA)
    return strip
