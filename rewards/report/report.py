"""Curves on paper: a picture, a table and a JSON file for one trajectory."""

import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from touchgoal.episodes.metadata import write_file
from touchgoal.rewards.curves import Curves

# Okabe and Ito, "Color universal design" (2008): told apart by colour-blind readers; the dashes
# tell them apart in grey.
STYLES: dict[str, dict[str, Any]] = {
    "image": {"color": "#0072B2", "linestyle": (0, (5, 2))},
    "tactile": {"color": "#D55E00", "linestyle": (0, (1.5, 1.5))},
    "text": {"color": "#CC79A7", "linestyle": (0, (5, 1.5, 1.5, 1.5))},
    "image+tactile": {"color": "#000000", "linestyle": "-"},
    "image+text": {"color": "#009E73", "linestyle": "-"},
}

PIXELS_PER_INCH = 100
SIZE_INCHES = (12.0, 7.0)
LABEL_GAP = 0.055
"""Least distance between two curve labels, as a share of the height of the axes."""


def write_report(
    curves: Curves, folder: Path, name: str, provenance: Mapping[str, Any]
) -> dict[str, Path]:
    """Write NAME.png, NAME.csv and NAME.json, each whole or not at all.

    Args:
        curves: what to report.
        folder: made if missing.
        name: file name without ending.
        provenance: what the curves were made with (encoder, towers, command, ...), for the JSON.

    Returns:
        The paths by kind: "png", "csv", "json".
    """
    contents = {
        "png": plot_curves(curves),
        "csv": curves_csv(curves).encode(),
        "json": (json.dumps(report_json(curves, provenance), indent=2) + "\n").encode(),
    }
    paths = {kind: folder / f"{name}.{kind}" for kind in contents}
    for kind, path in paths.items():
        write_file(path, contents[kind])
    return paths


def report_json(curves: Curves, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Metrics of every curve and what they rest on, ready for JSON."""
    return {
        "source": curves.source,
        "goal": dict(curves.goal),
        "frames": len(curves),
        "fps": curves.fps,
        "contact": {"frame": curves.contact.frame, "known_from": curves.contact.known_from},
        "unit": curves.unit,
        "metrics": {name: m.as_dict() for name, m in curves.metrics().items()},
        "provenance": dict(provenance),
    }


def curves_csv(curves: Curves) -> str:
    """CSV: frame, time (s), then every normalised curve and every raw one (`raw_` in front)."""
    columns = dict(curves.normalised) | {f"raw_{name}": d for name, d in curves.raw.items()}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["frame", "time_s", *columns])
    for t in range(len(curves)):
        row = [f"{column[t]:.6f}" for column in columns.values()]
        writer.writerow([t, f"{t / curves.fps:.4f}", *row])
    return text.getvalue()


def plot_curves(curves: Curves) -> bytes:
    """PNG of 1200 x 700 pixels: all curves over time, the contact marked, each line labelled."""
    figure = Figure(figsize=SIZE_INCHES, dpi=PIXELS_PER_INCH)
    axes = figure.add_axes((0.075, 0.11, 0.745, 0.74))
    time = np.arange(len(curves)) / curves.fps
    for name, d in curves.values.items():
        width = 2.6 if "+" in name else 1.8
        axes.plot(time, d, linewidth=width, **STYLES[name])
    _frame_axes(axes, curves, float(time[-1]))
    _mark_contact(axes, curves)
    _label_lines(axes, curves)
    goal = "goal: " + " and ".join(dict.fromkeys(curves.goal.values()))
    heading = {"fontsize": 15, "fontweight": "bold", "parse_math": False}
    figure.text(0.075, 0.935, _elide_middle(curves.source, 85), **heading)
    figure.text(0.075, 0.89, _elide_middle(goal, 125), fontsize=12, color="0.35", parse_math=False)
    png = io.BytesIO()
    FigureCanvasAgg(figure).print_png(png, metadata={"Software": None})
    return png.getvalue()


def _frame_axes(axes: Axes, curves: Curves, end: float) -> None:
    axes.set_xlabel("time (s)", fontsize=12)
    axes.set_ylabel(curves.unit, fontsize=12)
    axes.set_xlim(0, end)
    low, high = axes.get_ylim()
    if curves.normalised:
        low, high = min(low, -0.1), max(high, 1.15)
        # Each name stands where a good curve is not: the start's at the end and the reverse.
        for level, name, x, side in (
            (1, "usual start", 0.995, "right"),
            (0, "usual end", 0.005, "left"),
        ):
            axes.axhline(level, color="0.6", linewidth=0.9, zorder=1)
            place = axes.get_yaxis_transform()
            axes.text(x, level, name, ha=side, va="bottom", color="0.5", transform=place)
    axes.set_ylim(low, high + 0.05 * (high - low))
    axes.grid(True, color="0.92", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=11, color="0.6")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("0.6")


def _mark_contact(axes: Axes, curves: Curves) -> None:
    contact = curves.contact
    if contact.frame is None:
        return
    time = contact.frame / curves.fps
    axes.axvline(time, color="0.35", linewidth=1.2, linestyle=(0, (2, 3)), zorder=1)
    right = time > 0.85 * axes.get_xlim()[1]
    axes.annotate(
        f"contact ({contact.known_from})",
        (time, 1),
        xycoords=("data", "axes fraction"),
        xytext=(-6 if right else 6, -2),
        textcoords="offset points",
        ha="right" if right else "left",
        va="top",
        fontsize=11,
        color="0.35",
    )


def _label_lines(axes: Axes, curves: Curves) -> None:
    """Name each line at its right end, outside the axes, moved apart where ends meet."""
    low, high = axes.get_ylim()
    names = sorted(curves.values, key=lambda name: curves.values[name][-1])
    ends = np.array([(curves.values[name][-1] - low) / (high - low) for name in names])
    for name, end, height in zip(names, ends, _spread_labels(ends), strict=True):
        color = STYLES[name]["color"]
        axes.annotate(
            name,
            (1, end),
            xycoords="axes fraction",
            xytext=(1.045, height),
            textcoords="axes fraction",
            va="center",
            fontsize=12.5,
            fontweight="bold" if "+" in name else "normal",
            color=color,
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": color, "linewidth": 0.8, "shrinkA": 1},
        )


def _spread_labels(heights: np.ndarray) -> np.ndarray:
    """Ascending heights moved apart to at least LABEL_GAP, kept about their mean."""
    rank = np.arange(len(heights)) * LABEL_GAP
    spread = np.maximum.accumulate(heights - rank) + rank
    return spread + np.mean(heights - spread)


def _elide_middle(text: str, length: int) -> str:
    """The text, its middle left out if it is longer than the picture is wide."""
    half = (length - 3) // 2
    return text if len(text) <= length else f"{text[:half]} … {text[-half:]}"
