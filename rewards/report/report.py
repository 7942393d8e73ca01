"""Report of one trajectory (a plot and a CSV), and of all that were measured."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from touchgoal.rewards.curves import Curves
from touchgoal.rewards.report.frame_table import PROGRESS, write_frames, write_progress
from touchgoal.rewards.report.page import write_pages
from touchgoal.rewards.report.plot import plot
from touchgoal.rewards.report.record import Record, columns_of
from touchgoal.rewards.report.tables import MOST_CURVES, ends_table, metrics_table, outcome_table
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.json_file import write_json

_LISTED = "source object outcome goal own_goal unit contact contact_source fps measured".split()
"""Facts of each trajectory in metrics.json."""


def write_report(
    curves: Curves, folder: Path, name: str, with_plot: bool = True, about: str = ""
) -> None:
    """Write NAME.csv and, on request, NAME.png, each atomically; the plot's title ends with `about`."""
    write_file(folder / f"{name}.csv", curves_csv(curves).encode())
    if with_plot:
        png = io.BytesIO()
        FigureCanvasAgg(plot(curves, about=about)).print_png(png, metadata={"Software": None})
        write_file(folder / f"{name}.png", png.getvalue())


def report_all(records: Sequence[Path], out: Path, provenance: Mapping[str, Any]) -> str:
    """Write the reports of all records: metrics, tables for LeRobot, pages; print the tables.

    Return why the reward is not to be trained on, "" if nothing speaks against it.
    """
    facts = [Record.load(path).facts for path in records]
    write_json(out / "metrics.json", [{key: getattr(f, key) for key in _LISTED} for f in facts])
    write_frames(records, facts, out, provenance)
    if facts[0].normalised:
        write_progress(records, out)
    tables = [metrics_table(facts, most=MOST_CURVES), ends_table(facts)]
    if any(one.success is False for one in facts):
        tables.append(outcome_table(facts))
    page = write_pages(records, facts, out, tables[2:])
    print("\n\n".join(tables))
    if not facts[0].normalised:
        print(f"no {PROGRESS}: raw distances are no progress; normalise them (fit-normalizer)")
    print(f"page: {page}")
    if not (bare := sum(one.goal_untouched for one in facts)):
        return ""
    return (
        f"in {bare} of {len(facts)} the goal is untouched though the trajectory touches: a grasp raises "
        "the cost of touch; choose a goal in contact, and do not train on this reward"
    )


def curves_csv(curves: Curves) -> str:
    """Return a CSV with a row per frame.

    Columns: frame, time (s); for every curve `cost_`, `reward_` (-cost) and `potential_reward_`
    (see `potential_reward`); `cosine_distance_` of every single modality.
    """
    frames = np.arange(len(curves))
    columns = {"frame": frames, "time_s": frames / curves.fps, **columns_of(curves)}
    formats = ["%d", "%.4f", *["%.6f"] * (len(columns) - 2)]
    text, table = io.StringIO(), np.column_stack(list(columns.values()))
    np.savetxt(text, table, formats, ",", header=",".join(columns), comments="")
    return text.getvalue()
