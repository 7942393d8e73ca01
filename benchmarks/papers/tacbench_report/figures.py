"""TacBench's figures, laid out as the paper's: tasks by share of labels, and predictions."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from touchgoal.benchmarks.papers.tacbench.probes import END_TO_END, RANDOM
from touchgoal.benchmarks.papers.tacbench_report.published import SHARES, published
from touchgoal.benchmarks.papers.tacbench_report.tables import LAYOUTS
from touchgoal.benchmarks.papers.tacbench_report.task_figures import (
    Read,
    draw_field,
    draw_force,
    draw_labels,
    draw_pose,
    draw_slip,
)

Picture = UInt8[np.ndarray, "h w 3"]
_CONTRASTED_AT = 1 / 3  # of the labels, as in the paper's figures
_TITLES = {
    "force": "T1: mean absolute error of the force (mN)",
    "field": "T1A: share of the shear field explained",
    "slip": "T2: F1 of slip",
    "pose": "T3: accuracy of the change of pose",
    "grasp": "T4: accuracy of grasp stability",
    "textile": "T6: accuracy over 20 cloths",
}


def pictures(rows: list[dict[str, Any]], reads: list[Read], sensor: str) -> dict[str, Picture]:
    """Return all figures that the run's numbers give, by name."""
    drawn = {"by_labels": _draw_by_labels(rows, sensor)}
    for name in dict.fromkeys(read.name for read in reads):
        contrasted = _contrasted(rows, [read for read in reads if read.name == name])
        drawn[name] = _draw_task(name, contrasted)
    return drawn


def _contrasted(rows: list[dict[str, Any]], reads: list[Read]) -> list[Read]:
    """Return the best frozen encoder and the best end-to-end one at about a third of the labels."""
    share = min({read.share for read in reads}, key=lambda s: abs(s - _CONTRASTED_AT))
    test = reads[0].test
    layout = LAYOUTS[reads[0].name]
    same = [r for r in reads if (r.share, r.test) == (share, test)]

    def badness(read: Read) -> float:
        row = next(
            row
            for row in rows
            if (row["task"], row["encoder"], row["share"], row["test"])
            == (read.name, read.encoder, share, test)
        )
        return row[layout.measure] * (1 if layout.less_is_better else -1)

    trained = [r for r in same if r.encoder.startswith(END_TO_END)]
    frozen = [r for r in same if not r.encoder.startswith((END_TO_END, RANDOM))]
    kinds = [kind for kind in (frozen, trained) if kind] or [same]
    return [min(kind, key=badness) for kind in kinds]


def _draw_task(name: str, contrasted: list[Read]) -> Picture:
    drawers: dict[str, tuple[Callable[..., None], int, float]] = {
        "force": (draw_force, 4, 3.6),
        "field": (draw_field, 6, 2.7),
        "slip": (draw_slip, 4, 3.0),
        "pose": (draw_pose, 4, 3.8),
        "grasp": (draw_labels, 2, 3.8),
        "textile": (draw_labels, 1, 8.0),
    }
    drawer, columns, height = drawers[name]
    across = name in ("grasp", "textile")  # encoders side by side
    lines = 1 if across else len(contrasted) * (2 if name == "field" else 1)
    wide = len(contrasted) * columns if across else columns
    each = height * (1.25 if across else 1.1)
    figure = Figure(figsize=(wide * each, lines * height + 0.5), dpi=80, layout="constrained")
    axes = figure.subplots(lines, wide, squeeze=False)
    for k, one in enumerate(contrasted):
        if across:
            own = axes[0, k * columns : (k + 1) * columns]
        else:
            own = axes[k] if name != "field" else axes[2 * k : 2 * k + 2]
        drawer(own, one)
    share, test = contrasted[0].share, contrasted[0].test
    figure.suptitle(f"{_TITLES[name].split(':')[0]} with {share:.2g} of the labels, test: {test}")
    return _rendered(figure)


def _draw_by_labels(rows: list[dict[str, Any]], sensor: str) -> Picture:
    """Draw bars for each share of the labels with 95 % intervals, and the paper's numbers as
    marks."""
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
    handles, labels = axes.flat[0].get_legend_handles_labels()
    for axis in axes.flat[1 : len(shown)]:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            if label not in labels:
                handles, labels = [*handles, handle], [*labels, label]
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9)
    return _rendered(figure)


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
        axis.text(
            place,
            row[measure],
            row["encoder"],
            fontsize=7,
            ha=side,
            va="bottom",
            bbox=box,
            zorder=5,
        )
    if not LAYOUTS[task].less_is_better:  # an explained share may be far below 0
        axis.set_ylim(max(axis.get_ylim()[0], -0.5), 1.02)
    _draw_published(axis, shares, task, sensor)
    axis.set_xticks(range(len(shares)), [_share_name(share) for share in shares])
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


def _share_name(share: float) -> str:
    return "all" if share == 1 else f"1/{round(1 / share)}"


def _rendered(figure: Figure) -> Picture:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
