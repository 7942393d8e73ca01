"""Films of simulated episodes: pictures, a curve beside them, a caption below."""

import io
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from touchgoal.control.features import TRUTH_PROGRESS
from touchgoal.episodes.media import write_video
from touchgoal.episodes.schema import Episode
from touchgoal.sim_envs.scene.filming import TICKS_PER_PICTURE

COLORS = ("#0072B2", "#D55E00", "#CC79A7", "#000000", "#009E73")
"""Okabe and Ito, "Color universal design" (2008): distinct for colour-blind readers."""
_DPI = 100
_PANEL = 320  # px, width of the curves
_CAPTION = 24  # px, height of the caption


def write_film(
    path: Path,
    pictures: UInt8[np.ndarray, "n h w 3"],
    episode: Episode,
    control_hz: int,
    curves: Mapping[str, Float[np.ndarray, " ticks"]] | None = None,
    label: str = "",
) -> None:
    """Write an MP4 that plays in real time: pictures, curves up to now, object, outcome, seed, time.

    Args:
        path: of the file.
        pictures: of `record_with_film`, one every `TICKS_PER_PICTURE` ticks.
        episode: the episode, for the caption.
        control_hz: ticks per second.
        curves: values at each tick; default: the simulator's progress.
        label: axis label of the curves.
    """
    if curves is None:
        curves, label = {"progress": episode.frames[TRUTH_PROGRESS][:, 0]}, "progress"
    panel, left, right = _draw_panel(pictures.shape[1], curves, control_hz, label)
    seconds = np.arange(len(pictures)) * TICKS_PER_PICTURE / control_hz
    end = (len(episode) - 1) / control_hz
    frames = [
        np.vstack(
            [
                np.hstack([picture, _up_to(panel, round(left + t / end * (right - left)))]),
                _caption(picture.shape[1] + _PANEL, caption_of(episode), f"{t:.1f} s"),
            ]
        )
        for picture, t in zip(pictures, seconds, strict=True)
    ]
    write_video(path, np.stack(frames), control_hz / TICKS_PER_PICTURE)


def caption_of(episode: Episode) -> str:
    """Return object or wire, outcome and seed: "glass_ball: success, seed 7"."""
    meta = episode.meta
    name = meta.get("object") or meta.get("wire") or meta.get("task", "episode")
    outcome = "success" if meta.get("success") else meta.get("outcome", "outcome unknown")
    return f"{name}: {outcome}, seed {meta.get('seed', 'unknown')}"


def _draw_panel(
    height: int, curves: Mapping[str, np.ndarray], control_hz: int, label: str
) -> tuple[np.ndarray, float, float]:
    """Return the panel of all curves, and the columns (px) at which its time axis starts and ends."""
    figure = Figure(figsize=(_PANEL / _DPI, height / _DPI), dpi=_DPI)
    axes = figure.add_axes((0.16, 0.17, 0.8, 0.66))
    for (name, values), color in zip(curves.items(), COLORS, strict=False):
        axes.plot(np.arange(len(values)) / control_hz, values, color=color, label=name, lw=1.5)
    length = max(len(values) for values in curves.values())
    axes.set_xlim(0, (length - 1) / control_hz)
    axes.set_xlabel("time (s)", fontsize=7, labelpad=1)
    axes.set_ylabel(label, fontsize=7, labelpad=2)
    axes.tick_params(labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="upper center", ncols=3, fontsize=7, frameon=False, handlelength=1.2)
    png = io.BytesIO()
    FigureCanvasAgg(figure).print_png(png)
    box = axes.get_window_extent()
    return np.asarray(Image.open(png).convert("RGB")), box.x0, box.x1


def _up_to(panel: np.ndarray, column: int) -> np.ndarray:
    """Return the panel with what lies after the column faded, and a line at it."""
    shown = panel.copy()
    shown[:, column:] = 255 - (255 - shown[:, column:]) // 5
    shown[:, column - 1 : column + 1] = 90
    return shown


def _caption(width: int, left: str, right: str) -> np.ndarray:
    strip = np.zeros((_CAPTION, width, 3), np.uint8)
    font, white = (cv2.FONT_HERSHEY_SIMPLEX, 0.45), (255, 255, 255)
    cv2.putText(strip, left, (6, 16), *font, white, 1, cv2.LINE_AA)
    (wide, _), _ = cv2.getTextSize(right, *font, 1)
    cv2.putText(strip, right, (width - 6 - wide, 16), *font, white, 1, cv2.LINE_AA)
    return strip
