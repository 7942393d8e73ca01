"""TacBench as a table, beside the paper's figures on real sensors."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from benchmarks.papers.tacbench.config import Config
from benchmarks.papers.tacbench.probes import END_TO_END, RANDOM
from benchmarks.papers.tacbench_report.published import BEST_AGAINST_END_TO_END, SHARES, published

Row = dict[str, Any]


@dataclass(frozen=True)
class Layout:
    """Layout of a task's rows."""

    title: str
    measure: str  # key of the main number
    others: dict[str, Callable[[Row], str]]  # further numbers by header
    digits: int = 3
    less_is_better: bool = False


def _axis(key: str, k: int, digits: int) -> Callable[[Row], str]:
    return lambda row: f"{row[key][k]:.{digits}f}"


def _number(key: str, digits: int) -> Callable[[Row], str]:
    return lambda row: f"{row[key]:.{digits}f}" if key in row else ""


LAYOUTS: dict[str, Layout] = {
    "force": Layout(
        "T1, force on the pad, mN: mean absolute error; root mean square error, by axis and of all",
        "mae_mn",
        {axis: _axis("rmse_mn_by_axis", k, 0) for k, axis in enumerate("xyz")}
        | {"RMSE": _number("rmse_mn", 0)},
        digits=0,
        less_is_better=True,
    ),
    "field": Layout(
        "T1A, force field where the pad is touched: share of the shear's variation explained, and of the "
        "pressure's; root mean square errors, kPa",
        "shear_explained",
        {
            "pressure": _number("pressure_explained", 3),
            "shear": _number("shear_rmse_kpa", 2),
            "press.": _number("pressure_rmse_kpa", 2),
        },
    ),
    "slip": Layout(
        "T2, whether the sphere slips: F1; mean absolute error of the change of force, mN",
        "f1",
        {"change": _number("change_mae_mn", 0)},
    ),
    "pose": Layout(
        "T3, change of the pose of a bar and a can in 11 classes: accuracy; by axis; within one class",
        "accuracy",
        {name: _axis("accuracy_by_axis", k, 3) for k, name in enumerate(("x", "y", "turn"))}
        | {"within": _number("within_one_class", 3)},
    ),
    "grasp": Layout(
        "T4, whether a grasp holds: accuracy; mean of both outcomes' accuracies",
        "accuracy",
        {"balanced": _number("balanced_accuracy", 3)},
    ),
    "textile": Layout(
        "T6, which of 20 cloths: accuracy; mean of all cloths' accuracies",
        "accuracy",
        {"balanced": _number("balanced_accuracy", 3)},
    ),
}


def table(rows: list[Row], sensor: str, config: Config) -> str:
    """Return the table as text."""
    recorded = (
        f"simulated: {sensor}, {config.strokes} strokes, {config.slides} slides, {config.grasps} "
        f"grasps, {config.cloths} presses of cloth"
    )
    trained = f"{config.seeds} training seed{'s' * (config.seeds > 1)}"
    lines = [f"TacBench, {recorded}, {trained}; [95 % over test recordings]"]
    for task in config.tasks:
        lines += ["", *_task_lines([row for row in rows if row["task"] == task], task)]
        lines += _published_lines(task, sensor)
    return "\n".join([*lines, "", *_summary(rows, config)])


def _task_lines(rows: list[Row], task: str) -> list[str]:
    layout = LAYOUTS[task]
    headers = "".join(f"{name:>9}" for name in layout.others)
    name = layout.measure.removesuffix("_mn").replace("_", " ")
    lines = [
        layout.title,
        f"{'encoder':<36}{'tested on':<20}{'labels':>7}{name:>16}{'':>16}{headers}",
    ]
    for row in rows:
        low, high = (f"{end:.{layout.digits}f}" for end in row[f"{layout.measure}_interval"])
        others = "".join(f"{print_(row):>9}" for print_ in layout.others.values())
        value = f"{row[layout.measure]:.{layout.digits}f}"
        about = f"{row['encoder']:<36}{row['test']:<20}{row['samples']:>7}"
        lines.append(f"{about}{value:>16}{f'[{low}, {high}]':>16}{others}")
    return lines


def _published_lines(task: str, sensor: str) -> list[str]:
    known = published(task, sensor)
    if known is None:
        return []
    shares = "".join(f"{f'{share:.2g}':>9}" for share in SHARES)
    lines = [f"{f'paper, real {known.sensor}, share of labels ({known.measure})':<66}{shares}"]
    for encoder, values in known.values.items():
        numbers = "".join(f"{value:>9.{known.digits}f}" for value in values)
        lines.append(f"{f'  {encoder}':<66}{numbers}")
    return lines


def _summary(rows: list[Row], config: Config) -> list[str]:
    """Compare the best frozen encoder with the best end-to-end one, as Table 11."""
    shares = "".join(f"{share:>14.2g}" for share in config.shares)
    head = "best frozen encoder against end to end, %; * intervals apart"
    lines = [f"{head:<66}{shares}   paper"]
    for task in config.tasks:
        for test in dict.fromkeys(row["test"] for row in rows if row["task"] == task):
            cells = [_gain(rows, task, test, share) for share in config.shares]
            if any(cells):
                paper = BEST_AGAINST_END_TO_END.get(task)
                published_cell = "" if paper is None else f"{paper:8.0f}"
                ours = "".join(f"{cell:>14}" for cell in cells)
                lines.append(f"{f'  {task}, {test}':<66}{ours}{published_cell}")
    return lines if len(lines) > 1 else []


def _gain(rows: list[Row], task: str, test: str, share: float) -> str:
    """Return by how many percent frozen is better; empty without either kind."""
    layout = LAYOUTS[task]
    key, sign = layout.measure, -1 if layout.less_is_better else 1
    same = [r for r in rows if (r["task"], r["test"], r["share"]) == (task, test, share)]
    trained = [r for r in same if r["encoder"].startswith(END_TO_END)]
    frozen = [r for r in same if not r["encoder"].startswith((END_TO_END, RANDOM, "("))]
    if not trained or not frozen:
        return ""
    best, other = (max(kind, key=lambda r: sign * r[key]) for kind in (frozen, trained))
    gain = 100 * sign * (best[key] - other[key]) / max(abs(other[key]), 1e-9)
    (low, high), (least, most) = (r[f"{key}_interval"] for r in (best, other))
    return f"{gain:+.0f}{'*' * (low > most or least > high)}"
