"""Report of one trajectory: a plot, a CSV and a JSON; and the table of all."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from touchgoal.rewards.curves import GAMMA, Curves
from touchgoal.rewards.report.summary import metrics_table
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.json_file import write_json


def write_report(
    curves: Curves, folder: Path, name: str, provenance: Mapping[str, Any], gamma: float = GAMMA
) -> dict[str, Path]:
    """Write NAME.png, NAME.csv and NAME.json, each atomically; return the paths by kind.

    The JSON also holds what the curves were made with (encoder, towers, command).
    """
    png = io.BytesIO()
    FigureCanvasAgg(curves.plot(gamma)).print_png(png, metadata={"Software": None})
    contents = {
        "png": png.getvalue(),
        "csv": curves_csv(curves, gamma).encode(),
        "json": (json.dumps(report_json(curves, provenance, gamma), indent=2) + "\n").encode(),
    }
    paths = {kind: folder / f"{name}.{kind}" for kind in contents}
    for kind, path in paths.items():
        write_file(path, contents[kind])
    return paths


def report_all(curves: Sequence[Curves], out: Path) -> None:
    """Print the table of all curves and write their metrics to metrics.json."""
    write_json(
        out / "metrics.json",
        [{"source": c.source, **{k: m.as_dict() for k, m in c.metrics().items()}} for c in curves],
    )
    print(metrics_table(curves))


def report_json(
    curves: Curves, provenance: Mapping[str, Any], gamma: float = GAMMA
) -> dict[str, Any]:
    """Return metrics, costs and rewards of every curve, and how they were made, ready for JSON."""
    return {
        "source": curves.source,
        "goal": dict(curves.goal),
        "frames": len(curves),
        "fps": curves.fps,
        "contact": {"frame": curves.contact.frame, "label_source": curves.contact.label_source},
        "unit": curves.unit,
        "metrics": {name: m.as_dict() for name, m in curves.metrics().items()},
        "cost": {"values": _rounded(curves.costs)},
        "state_reward": {"definition": "-cost", "values": _rounded(curves.rewards)},
        "potential_reward": {
            "definition": "gamma * Phi(frame) - Phi(frame before), Phi = -cost; 0 at frame 0",
            "gamma": gamma,
            "values": _rounded(curves.potential_rewards(gamma)),
        },
        "goal_is_own_frame": sorted(curves.same_episode),
        "provenance": dict(provenance),
    }


def _rounded(curves: Mapping[str, np.ndarray]) -> dict[str, list[float]]:
    return {name: np.round(values, 6).tolist() for name, values in curves.items()}


def curves_csv(curves: Curves, gamma: float = GAMMA) -> str:
    """Return a CSV with a row a frame.

    Columns: frame, time (s); for every curve `cost_`, `reward_` (-cost) and `potential_reward_`
    (gamma * Phi(frame) - Phi(frame before)); `cosine_distance_` of every single modality.
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
