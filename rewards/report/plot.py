"""Plots of cost and reward curves, one panel under another."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from touchgoal.rewards.curves import FUSED, GAMMA, Curves, main_curve, reference_levels

_COLORS = {  # Okabe and Ito, "Color universal design" (2008), distinct for colour-blind readers, and a brown
    "#0072B2": ("image", "front", "slip"),
    "#D55E00": ("tactile", "object", "wrench"),
    "#CC79A7": ("text", "words", "force"),
    "#009E73": ("image+tactile", "wrist", "value"),
    "#56B4E9": ("image+text", "wrist_map"),
    "#E69F00": ("centre",),
    "#7A5C2E": ("held",),
}
CURVES = {name: color for color, names in _COLORS.items() for name in names} | {FUSED: "#000000"}
"""Colour of each curve that has a name, in plots, pages and films."""
_DASHES = ((0, (5, 2)), (0, (1.5, 1.5)), (0, (5, 1.5, 1.5, 1.5)), "-", (0, (3, 1)), (0, (8, 2)))
_SIZE = (12.0, 10.0)  # inches, at 100 pixels an inch
_PANELS = ((0.53, 0.345), (0.275, 0.17), (0.06, 0.15))  # bottom and height of each panel
_LABEL_GAP = 0.06  # least distance between two curve labels, share of the first panel's height


def plot(curves: Curves, gamma: float = GAMMA, about: str = "") -> Figure:
    """Return a figure of costs and rewards over time: `plot(curves).savefig("curves.png")`.

    The first contact and the reference levels are marked. With parts, the rewards are those of the
    fused cost. `about`, such as object and outcome, follows the title.
    """
    costs = curves.costs
    main = main_curve(costs)
    rewarded = [main] if main == FUSED else list(costs)
    potential = curves.potential_rewards(gamma)
    unit = "distance to goal (cost, normalised)" if curves.normalised else f"cost: {curves.unit}"
    panels = (
        (unit, costs),
        ("state reward\n= -cost", {name: curves.rewards[name] for name in rewarded}),
        (f"potential-based reward\nγ = {gamma:g} per second", {n: potential[n] for n in rewarded}),
    )
    fps, contact = curves.fps, curves.contact
    styles, several = line_styles(list(costs)), len(costs) > 1
    width = 0.725 if several else 0.88  # names stand beside several curves, a lone one's above
    figure = Figure(figsize=_SIZE, dpi=100)
    length = len(curves)
    for k, ((label, lines), (bottom, height)) in enumerate(zip(panels, _PANELS, strict=True)):
        axes = figure.add_axes((0.095, bottom, width, height))
        for name, line in lines.items():
            axes.plot(np.arange(length) / fps, line, **styles[name])
        _frame_axes(axes, label, (length - 1) / fps)
        if k == 0:
            _frame_costs(axes, reference_levels(lines, bool(curves.normalised)))
        if contact.frame is not None:
            name = f"contact ({contact.label_source})" * (k == 0)
            _mark_contact(axes, contact.frame / fps, name)
        axes.tick_params(labelbottom=k != 1)
        # In the last panel all curves end near 0: colours and dashes distinguish them.
        if several and k < 2:
            _label_lines(axes, lines, styles, _LABEL_GAP * _PANELS[0][1] / height)
    figure.axes[-1].set_xlabel("time (s)", fontsize=12)
    goals = " and ".join(dict.fromkeys(curves.goal.values()))
    heading = _elide_middle(" · ".join(filter(None, (curves.source, about))), 85)
    goal = _elide_middle(f"goal: {goals}" if several else f"{main} · goal: {goals}", 125)
    figure.text(0.095, 0.95, heading, fontsize=15, fontweight="bold", parse_math=False)
    figure.text(0.095, 0.915, goal, fontsize=12, color="0.35", parse_math=False)
    return figure


def curve_colors(names: Sequence[str]) -> dict[str, str]:
    """Return the colours of `CURVES`; other names, such as a camera's, get what is left."""
    taken = {CURVES.get(name) for name in names}
    left = cycle([color for color in _COLORS if color not in taken] or _COLORS)
    return {name: CURVES.get(name) or next(left) for name in names}


def line_styles(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return colour, dashes and width of each curve; the main one is thick, and a lone one solid.

    Colours are for the colour-blind, too; the dashes distinguish them in grey.
    """
    main, dashes = main_curve(names), cycle(_DASHES)
    thick, thin = {"linestyle": "-", "linewidth": 2.6}, {"linewidth": 1.8}
    return {
        name: {"color": color} | (thick if name == main else thin | {"linestyle": next(dashes)})
        for name, color in curve_colors(names).items()
    }


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


def _frame_costs(axes: Axes, levels: Sequence[tuple[float, str]]) -> None:
    """Include 0 in the cost axis, and mark the reference levels."""
    low, high = axes.get_ylim()
    axes.set_ylim(min(-0.03 * high, low), high)
    if not levels:
        return
    axes.set_ylim(min(-0.04, low), max(high, 1.2))
    for level, name in levels:
        # Each name stands where a good curve is not: the goal's at the start, the others' at the end.
        x, side = (0.995, "right") if level else (0.005, "left")
        axes.axhline(level, color="0.6", linewidth=0.9, zorder=1)
        place = axes.get_yaxis_transform()
        axes.text(x, level, name, ha=side, va="bottom", color="0.5", transform=place)


def _mark_contact(axes: Axes, time: float, name: str) -> None:
    axes.axvline(time, color="0.35", linewidth=1.2, linestyle=(0, (2, 3)), zorder=1)
    side, gap = ("right", -6) if time > 0.85 * axes.get_xlim()[1] else ("left", 6)
    at = {"xycoords": ("data", "axes fraction"), "xytext": (gap, -2), "textcoords": "offset points"}
    axes.annotate(name, (time, 1), **at, ha=side, va="top", fontsize=11, color="0.35")


def _label_lines(
    axes: Axes,
    values: Mapping[str, np.ndarray],
    styles: Mapping[str, Mapping[str, Any]],
    gap: float,
) -> None:
    """Name each line at its right end, outside the axes, moved apart where ends meet."""
    low, high = axes.get_ylim()
    names = sorted(values, key=lambda name: values[name][-1])
    look: dict[str, Any] = dict.fromkeys(("xycoords", "textcoords"), "axes fraction")
    look |= {"va": "center", "annotation_clip": False, "fontsize": 12.5}
    arrow = {"arrowstyle": "-", "linewidth": 0.8, "shrinkA": 1, "relpos": (0, 0.5)}
    ends = np.array([(values[name][-1] - low) / (high - low) for name in names])
    rank = np.arange(len(ends)) * gap
    spread = np.maximum.accumulate(ends - rank) + rank
    heights = spread + np.mean(ends - spread)
    for name, end, height in zip(names, ends, heights, strict=True):
        color, weight = styles[name]["color"], "bold" if styles[name]["linewidth"] > 2 else "normal"
        text, line = {"color": color, "fontweight": weight, **look}, {"color": color, **arrow}
        axes.annotate(name, (1, end), xytext=(1.045, height), arrowprops=line, **text)


def _elide_middle(text: str, length: int) -> str:
    """Return the text without its middle if it is longer than the plot is wide."""
    half = (length - 3) // 2
    return text if len(text) <= length else f"{text[:half]} … {text[-half:]}"
