"""TacBench's figure, laid out as the paper's: every task by share of labels."""

from typing import Any

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.papers.tacbench.probes import END_TO_END, RANDOM
from benchmarks.papers.tacbench_report.published import SHARES, published
from benchmarks.papers.tacbench_report.tables import LAYOUTS

_TITLES = {
    "force": "T1: mean absolute error of the force (mN)",
    "field": "T1A: share of the shear field explained",
    "slip": "T2: F1 of slip",
    "pose": "T3: accuracy of the change of pose",
    "grasp": "T4: accuracy of grasp stability",
    "textile": "T6: accuracy over 20 cloths",
}


def draw_by_labels(rows: list[dict[str, Any]], sensor: str) -> UInt8[np.ndarray, "h w 3"]:
    """Draw bars for each share of the labels with 95 % intervals; the paper's numbers as marks."""
    shown = [
        (task, test)
        for task in dict.fromkeys(row["task"] for row in rows)
        for test in dict.fromkeys(row["test"] for row in rows if row["task"] == task)
    ]
    columns = min(len(shown), 3)
    lines = -(-len(shown) // columns)
    figure = Figure(figsize=(6.2 * columns, 3.7 * lines + 0.4), dpi=80, layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False)
    for axis, (task, test) in zip(axes.flat, shown, strict=False):
        own = [row for row in rows if (row["task"], row["test"]) == (task, test)]
        _draw_bars(axis, own, task, test, sensor)
    for axis in axes.flat[len(shown) :]:
        axis.axis("off")
    handles: dict[str, Any] = {}
    for axis in axes.flat[: len(shown)]:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    legend = list(handles.values()), list(handles)
    figure.legend(*legend, loc="outside lower center", ncols=3, fontsize=9)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _draw_bars(axis: Axes, rows: list[dict[str, Any]], task: str, test: str, sensor: str) -> None:
    measure = LAYOUTS[task].measure
    measured = [row for row in rows if not row["encoder"].startswith("(")]
    shares = sorted({row["share"] for row in measured}, reverse=True)
    encoders = list(dict.fromkeys(row["encoder"] for row in measured))
    width = 0.8 / len(encoders)
    for k, encoder in enumerate(encoders):
        own = sorted((r for r in measured if r["encoder"] == encoder), key=lambda r: -r["share"])
        values = np.array([row[measure] for row in own])
        ends = np.array([row[f"{measure}_interval"] for row in own]).T
        places = np.array([shares.index(r["share"]) for r in own]) + (k + 0.5) * width - 0.4
        spread = np.maximum([values - ends[0], ends[1] - values], 0)
        hatch = "//" if encoder.startswith(END_TO_END) else ""
        colour = "0.7" if encoder.startswith(RANDOM) else f"C{k}"
        axis.bar(
            places, values, width, yerr=spread, capsize=2, label=encoder, color=colour, hatch=hatch
        )
    references = [row for row in rows if row["encoder"].startswith("(")]
    for k, row in enumerate(references):
        axis.axhline(row[measure], color="0.3", linewidth=0.9, linestyle=":")
        place, side = ((len(shares) - 0.55, "right"), (-0.45, "left"))[k % 2]
        box = {"facecolor": "w", "alpha": 0.7, "edgecolor": "none", "pad": 0.5}
        style: dict[str, Any] = {"fontsize": 7, "ha": side, "va": "bottom", "zorder": 5}
        axis.text(place, row[measure], row["encoder"], bbox=box, **style)
    if not LAYOUTS[task].less_is_better:  # an explained share may be far below 0
        axis.set_ylim(max(axis.get_ylim()[0], -0.5), 1.02)
    _draw_published(axis, shares, task, sensor)
    names = ["all" if share == 1 else f"1/{round(1 / share)}" for share in shares]
    axis.set_xticks(range(len(shares)), names)
    axis.set(xlabel="share of the labels", title=f"{_TITLES[task]}\n{test}")
    axis.title.set_fontsize(10)


def _draw_published(axis: Axes, shares: list[float], task: str, sensor: str) -> None:
    known = published(task, sensor)
    if known is None:
        return
    best = max if not LAYOUTS[task].less_is_better else min
    sparsh = [values for name, values in known.values.items() if name != "E2E"]
    lines = {
        "paper, E2E": known.values["E2E"],
        "paper, best Sparsh": [best(v) for v in zip(*sparsh, strict=True)],
    }
    for (name, values), marker in zip(lines.items(), ("v", "^"), strict=True):
        at = [i for i, share in enumerate(shares) if _of_paper(share) is not None]
        seen = [values[_of_paper(shares[i])] for i in at]  # pyright: ignore[reportArgumentType]
        axis.plot(
            at, seen, marker, color="k", markerfacecolor="w", markersize=8, label=name, zorder=4
        )


def _of_paper(share: float) -> int | None:
    """Return which of the paper's shares this is."""
    near = [i for i, own in enumerate(SHARES) if abs(share / own - 1) < 0.05]
    return near[0] if near else None
