"""Report of one trajectory (a plot, a CSV and a JSON), and of all that were measured."""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from touchgoal.rewards.curves import GAMMA, Curves
from touchgoal.rewards.report.frame_table import PROGRESS, write_frames, write_progress
from touchgoal.rewards.report.page import write_pages
from touchgoal.rewards.report.plot import plot
from touchgoal.rewards.report.record import Record, columns_of
from touchgoal.rewards.report.tables import MOST_CURVES, ends_table, metrics_table, outcome_table
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.json_file import write_json


def write_report(
    curves: Curves,
    folder: Path,
    name: str,
    provenance: Mapping[str, Any],
    with_plot: bool = True,
    about: str = "",
) -> dict[str, Path]:
    """Write NAME.csv, NAME.json and, on request, NAME.png, each atomically; return the paths by kind.

    The plot's title ends with `about`. The JSON also holds what the curves were made with (encoder, towers, command).
    """
    contents = {
        "csv": curves_csv(curves).encode(),
        "json": (json.dumps(report_json(curves, provenance), indent=2) + "\n").encode(),
    }
    if with_plot:
        png = io.BytesIO()
        FigureCanvasAgg(plot(curves, about=about)).print_png(png, metadata={"Software": None})
        contents["png"] = png.getvalue()
    paths = {kind: folder / f"{name}.{kind}" for kind in contents}
    for kind, path in paths.items():
        write_file(path, contents[kind])
    return paths


def report_all(records: Sequence[Path], out: Path, provenance: Mapping[str, Any]) -> str:
    """Write the reports of all records: metrics, tables for LeRobot, pages; print the tables.

    Return why the reward is not to be trained on, "" if nothing speaks against it.
    """
    facts = [Record.load(path).facts for path in records]
    about = [{"source": f.source, "object": f.object, "outcome": f.outcome} for f in facts]
    write_json(out / "metrics.json", [a | f.measured for a, f in zip(about, facts, strict=True)])
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


def report_json(curves: Curves, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return metrics, costs and rewards of every curve, and how they were made, ready for JSON."""
    return {
        "source": curves.source,
        "goal": dict(curves.goal),
        "frames": len(curves),
        "fps": curves.fps,
        "contact": {"frame": curves.contact.frame, "label_source": curves.contact.label_source},
        "unit": curves.unit,
        "metrics": {name: asdict(m) for name, m in curves.metrics().items()},
        "cost": {"values": _rounded(curves.costs)},
        "state_reward": {"definition": "-cost", "values": _rounded(curves.rewards)},
        "potential_reward": {
            "definition": "g Phi(frame) - Phi(frame before), g = gamma^(1 / fps), Phi = -cost",
            "gamma": GAMMA,
            "values": _rounded(curves.potential_rewards()),
        },
        "goal_is_own_frame": sorted(curves.same_episode),
        "provenance": dict(provenance),
    }


def _rounded(curves: Mapping[str, np.ndarray]) -> dict[str, list[float]]:
    return {name: np.round(values, 6).tolist() for name, values in curves.items()}


def curves_csv(curves: Curves) -> str:
    """Return a CSV with a row per frame.

    Columns: frame, time (s); for every curve `cost_`, `reward_` (-cost) and `potential_reward_`
    (see `report_json`); `cosine_distance_` of every single modality.
    """
    frames = np.arange(len(curves))
    columns = {"frame": frames, "time_s": frames / curves.fps, **columns_of(curves)}
    formats = ["%d", "%.4f", *["%.6f"] * (len(columns) - 2)]
    text, table = io.StringIO(), np.column_stack(list(columns.values()))
    np.savetxt(text, table, formats, ",", header=",".join(columns), comments="")
    return text.getvalue()
