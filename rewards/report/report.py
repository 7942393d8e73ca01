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

from touchgoal.rewards.curves import GAMMA, Curves
from touchgoal.runtime.atomic_write import write_file

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
SIZE_INCHES = (12.0, 10.0)
LABEL_GAP = 0.06
"""Least distance between two curve labels, as a share of the height of the tallest axes."""


def write_report(
    curves: Curves, folder: Path, name: str, provenance: Mapping[str, Any], gamma: float = GAMMA
) -> dict[str, Path]:
    """Write NAME.png, NAME.csv and NAME.json, each whole or not at all.

    Args:
        curves: what to report.
        folder: made if missing.
        name: file name without ending.
        provenance: what the curves were made with (encoder, towers, command, ...), for the JSON.
        gamma: discount of the potential-based reward.

    Returns:
        The paths by kind: "png", "csv", "json".
    """
    contents = {
        "png": plot_curves(curves, gamma),
        "csv": curves_csv(curves, gamma).encode(),
        "json": (json.dumps(report_json(curves, provenance, gamma), indent=2) + "\n").encode(),
    }
    paths = {kind: folder / f"{name}.{kind}" for kind in contents}
    for kind, path in paths.items():
        write_file(path, contents[kind])
    return paths


def report_json(
    curves: Curves, provenance: Mapping[str, Any], gamma: float = GAMMA
) -> dict[str, Any]:
    """Metrics, costs and rewards of every curve and what they rest on, ready for JSON."""
    return {
        "source": curves.source,
        "goal": dict(curves.goal),
        "frames": len(curves),
        "fps": curves.fps,
        "contact": {"frame": curves.contact.frame, "label_source": curves.contact.label_source},
        "unit": curves.unit,
        "metrics": {name: m.as_dict() for name, m in curves.metrics().items()},
        "cost": {
            "definition": _COST_NORMALISED if curves.normalised else _COST_RAW,
            "values": _rounded(curves.costs),
        },
        "state_reward": {
            "definition": "-cost",
            "range": "at most 0, about -1 at the usual start" if curves.normalised else "-2 to 0",
            "values": _rounded(curves.rewards),
        },
        "potential_reward": {
            "definition": "gamma * Phi(frame) - Phi(frame before), Phi = -cost; 0 at frame 0",
            "gamma": gamma,
            "values": _rounded(curves.potential_rewards(gamma)),
        },
        "causal": _causality(curves),
        "provenance": dict(provenance),
    }


_COST_NORMALISED = (
    "0 as near the goal as successful episodes usually end, or nearer; 1 where they usually start"
)
_COST_RAW = (
    "cosine distance 1 - cos between embeddings, 0 to 2; no normalizer was fitted on such data"
)


def _causality(curves: Curves) -> str:
    """Which frames the value of a frame depends on."""
    says = "a frame's values depend on no later frame"
    if {"tactile", "text"} & curves.raw.keys():
        says += "; the untouched fingertips are the median of the first 5 frames"
    if curves.own_goal:
        named = " and ".join(sorted(curves.own_goal))
        says += f"; but the goal of {named} is a frame of this trajectory, known at its end alone"
    return says


def _rounded(curves: Mapping[str, np.ndarray]) -> dict[str, list[float]]:
    return {name: np.round(values, 6).tolist() for name, values in curves.items()}


def curves_csv(curves: Curves, gamma: float = GAMMA) -> str:
    """CSV, a row a frame: frame, time (s), and for every curve `cost_`, `reward_` (-cost) and
    `potential_reward_` (gamma * Phi' - Phi), then `cosine_distance_` of every single modality.
    """
    columns = {
        f"{kind}_{name}": values
        for kind, group in (
            ("cost", curves.costs),
            ("reward", curves.rewards),
            ("potential_reward", curves.potential_rewards(gamma)),
            ("cosine_distance", curves.raw),
        )
        for name, values in group.items()
    }
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["frame", "time_s", *columns])
    for t in range(len(curves)):
        row = [f"{column[t]:.6f}" for column in columns.values()]
        writer.writerow([t, f"{t / curves.fps:.4f}", *row])
    return text.getvalue()


def plot_curves(curves: Curves, gamma: float = GAMMA) -> bytes:
    """PNG of 1200 x 1000 pixels, one panel under another: cost, state reward, potential-based reward.

    All curves over time, the contact marked, each line labelled at its end.
    """
    figure = Figure(figsize=SIZE_INCHES, dpi=PIXELS_PER_INCH)
    panels = (
        (0.53, 0.345, curves.costs, _cost_label(curves)),
        (0.275, 0.17, curves.rewards, "state reward\n= -cost"),
        (0.06, 0.15, curves.potential_rewards(gamma), f"potential-based\nreward, γ = {gamma:g}"),
    )
    for bottom, height, values, label in panels:
        axes = figure.add_axes((0.095, bottom, 0.725, height))
        _draw_lines(axes, curves, values)
        _frame_axes(axes, label, (len(curves) - 1) / curves.fps)
        if values is panels[0][2]:
            _frame_costs(axes, curves)
        _mark_contact(axes, curves, named=values is panels[0][2])
        if values is not panels[2][2]:  # all steps end near 0: the colours and dashes tell
            _label_lines(axes, values, LABEL_GAP * panels[0][1] / height)
            axes.tick_params(labelbottom=values is panels[0][2])
    figure.axes[-1].set_xlabel("time (s)", fontsize=12)
    goal = "goal: " + " and ".join(dict.fromkeys(curves.goal.values()))
    heading = {"fontsize": 15, "fontweight": "bold", "parse_math": False}
    figure.text(0.095, 0.95, _elide_middle(curves.source, 85), **heading)
    figure.text(0.095, 0.915, _elide_middle(goal, 125), fontsize=12, color="0.35", parse_math=False)
    png = io.BytesIO()
    FigureCanvasAgg(figure).print_png(png, metadata={"Software": None})
    return png.getvalue()


def _cost_label(curves: Curves) -> str:
    return curves.unit.replace("(normalised)", "(cost, normalised)").replace(
        "cosine", "cost: cosine"
    )


def _draw_lines(axes: Axes, curves: Curves, values: Mapping[str, np.ndarray]) -> None:
    time = np.arange(len(curves)) / curves.fps
    for name, line in values.items():
        axes.plot(time, line, linewidth=2.6 if "+" in name else 1.8, **STYLES[name])


def _frame_axes(axes: Axes, label: str, end: float) -> None:
    axes.set_ylabel(label, fontsize=12)
    axes.set_xlim(0, end)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.05 * (high - low))
    axes.grid(True, color="0.92", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=11, color="0.6")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("0.6")


def _frame_costs(axes: Axes, curves: Curves) -> None:
    """A cost axis begins at 0; a normalised one shows where successes usually start and end."""
    high = axes.get_ylim()[1]
    axes.set_ylim(-0.03 * high, high)
    if not curves.normalised:
        return
    axes.set_ylim(-0.04, max(high, 1.2))
    # Each name stands where a good curve is not: the start's at the end and the reverse.
    for level, name, x, side in (
        (1, "usual start", 0.995, "right"),
        (0, "usual end, or nearer", 0.005, "left"),
    ):
        axes.axhline(level, color="0.6", linewidth=0.9, zorder=1)
        place = axes.get_yaxis_transform()
        axes.text(x, level, name, ha=side, va="bottom", color="0.5", transform=place)


def _mark_contact(axes: Axes, curves: Curves, named: bool) -> None:
    contact = curves.contact
    if contact.frame is None:
        return
    time = contact.frame / curves.fps
    axes.axvline(time, color="0.35", linewidth=1.2, linestyle=(0, (2, 3)), zorder=1)
    if not named:
        return
    right = time > 0.85 * axes.get_xlim()[1]
    axes.annotate(
        f"contact ({contact.label_source})",
        (time, 1),
        xycoords=("data", "axes fraction"),
        xytext=(-6 if right else 6, -2),
        textcoords="offset points",
        ha="right" if right else "left",
        va="top",
        fontsize=11,
        color="0.35",
    )


def _label_lines(axes: Axes, values: Mapping[str, np.ndarray], gap: float) -> None:
    """Name each line at its right end, outside the axes, moved apart where ends meet."""
    low, high = axes.get_ylim()
    names = sorted(values, key=lambda name: values[name][-1])
    ends = np.array([(values[name][-1] - low) / (high - low) for name in names])
    for name, end, height in zip(names, ends, _spread_labels(ends, gap), strict=True):
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
            arrowprops={
                "arrowstyle": "-",
                "color": color,
                "linewidth": 0.8,
                "shrinkA": 1,
                "relpos": (0, 0.5),
            },
        )


def _spread_labels(heights: np.ndarray, gap: float) -> np.ndarray:
    """Ascending heights moved apart to at least `gap`, kept about their mean."""
    rank = np.arange(len(heights)) * gap
    spread = np.maximum.accumulate(heights - rank) + rank
    return spread + np.mean(heights - spread)


def _elide_middle(text: str, length: int) -> str:
    """The text, its middle left out if it is longer than the picture is wide."""
    half = (length - 3) // 2
    return text if len(text) <= length else f"{text[:half]} … {text[-half:]}"
