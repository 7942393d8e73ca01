"""Self-contained HTML pages: images and curves that scrub together, and a table of all trajectories.

Up to 100 trajectories are one page; more are pages of 100 and an index. No network is needed.
"""

import base64
import html
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from PIL import Image

from touchgoal.rewards.curves import main_curve, reference_levels
from touchgoal.rewards.report.plot import line_styles
from touchgoal.rewards.report.record import Facts, Record
from touchgoal.rewards.report.tables import COLUMNS
from touchgoal.rewards.report.thumbnails import COLUMNS as SHEET_COLUMNS
from touchgoal.runtime.atomic_write import write_file

PAGE = "report.html"
PER_PAGE = 100  # trajectories
_MOST_POINTS = 600  # of a curve in a page; a longer one is drawn by evenly spaced frames
_FILES = Path(__file__).parent / "page_files"
_WORDS = {"source": "trajectory", "object": "object", "outcome": "outcome"}
_DIGITS = {"t_drop_50": 0, "contact_lag": 0, "peaks": 0}  # they count; other metrics have 2


def write_pages(
    records: Sequence[Path], facts: Sequence[Facts], out: Path, tables: Sequence[str]
) -> Path:
    """Write the pages of all records; return the first one.

    `tables` are printed above the table of trajectories, each with its title as its first line.
    """
    starts = range(0, len(facts), PER_PAGE)
    names = [f"report_{k + 1:03d}.html" for k in range(len(starts))] if len(starts) > 1 else []
    rows: list[dict[str, Any]] = []
    for start, name in zip(starts, names or [PAGE], strict=True):
        loaded = [Record.load(path) for path in records[start : start + PER_PAGE]]
        page = _page(facts, list(map(_viewed, loaded)), names, tables)
        write_file(out / name, page.encode())
        rows += [
            _row(r.facts) | {"thumb": data_uri(r.thumb.tobytes()), "page": f"{name}#{r.facts.name}"}
            for r in loaded
        ]
    if names:
        write_file(out / PAGE, _page(facts, rows, names, tables).encode())
    return out / PAGE


def _page(
    facts: Sequence[Facts],
    episodes: Sequence[Mapping[str, Any]],
    pages: Sequence[str],
    tables: Sequence[str],
) -> str:
    goals = sorted({goal for f in facts for goal in f.goal.values()})
    listed = ", ".join(goals[:3]) + (f" and {len(goals) - 3} more" if len(goals) > 3 else "")
    links = [f'<a href="{PAGE}">all</a>'] if pages else []
    links += [f'<a href="{page}">{k + 1}</a>' for k, page in enumerate(pages)]
    number = f"{len(episodes)} trajectories" if len(episodes) > 1 else "1 trajectory"
    frames = f"{sum(e['frames'] for e in episodes):,} frames"
    names = list(dict.fromkeys(name for f in facts for name in f.measured))
    words = [
        {"key": key, "label": label, "word": True}
        for key, label in _WORDS.items()
        if any(getattr(f, key) for f in facts)
    ]
    metrics = [
        {"key": k, "label": name, "meaning": what, "metric": True, "digits": _DIGITS.get(k, 2)}
        for name, (k, what) in COLUMNS.items()
        if any(getattr(m, k) is not None for f in facts for m in f.measured.values())
    ]
    content = {
        "curves": names,
        "main": main_curve(names),
        "styles": line_styles(names),
        "unit": facts[0].unit,
        "levels": reference_levels(names, facts[0].normalised),
        "columns": [*words, {"key": "frames", "label": "frames", "digits": 0}, *metrics],
        "episodes": episodes,
    }
    return Template((_FILES / "page.html").read_text()).substitute(
        title=html.escape(f"Reward curves: {episodes[0]['source']}"),
        heading="Reward curves",
        subheading=html.escape(f"{number}, {frames} · goal: {listed} · {facts[0].unit}"),
        navigation=" ".join(links),
        style=(_FILES / "page.css").read_text(),
        script=(_FILES / "page.js").read_text(),
        tables="\n".join(_as_section(table) for table in tables),
        # "<" may not end the script element that holds the data
        data=json.dumps(content, separators=(",", ":")).replace("<", "\\u003c"),
    )


def _as_section(table: str) -> str:
    title, _, rest = table.partition("\n")
    return f"<section><h2>{html.escape(title)}</h2><pre>{html.escape(rest)}</pre></section>"


def _row(facts: Facts) -> dict[str, Any]:
    fields = [field for field, _ in COLUMNS.values()]
    shown = ("name", "source", "object", "outcome", "frames")
    measured = facts.measured.items()
    metrics = {name: {k: _short(getattr(m, k)) for k in fields} for name, m in measured}
    return {key: getattr(facts, key) for key in shown} | {"metrics": metrics}


def _viewed(record: Record) -> dict[str, Any]:
    """Return a row with curves and images."""
    facts = record.facts
    at = np.linspace(0, facts.frames - 1, min(facts.frames, _MOST_POINTS)).round().astype(int)
    return _row(facts) | {
        "fps": facts.fps,
        "contact": facts.contact,
        "contact_source": facts.contact_source,
        "shown": facts.shown,
        "at": at.tolist(),
        "curves": {n: [_short(v) for v in c[at].tolist()] for n, c in record.costs.items()},
        "peaks": facts.peaks,
        "sheets": {name: _sheet(sheet, len(facts.shown)) for name, sheet in record.sheets.items()},
    }


def _sheet(sheet: np.ndarray, count: int) -> dict[str, Any]:
    with Image.open(io.BytesIO(sheet.tobytes())) as image:
        columns, rows = min(count, SHEET_COLUMNS), math.ceil(count / SHEET_COLUMNS)
        width, height = image.width // columns, image.height // rows
    uri = data_uri(sheet.tobytes())
    return {"uri": uri, "columns": columns, "width": width, "height": height}


def data_uri(jpeg: bytes) -> str:
    """Return a JPEG as an address that holds it."""
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}"


def _short(value: float | int | None) -> float | int | None:
    return round(value, 4) if isinstance(value, float) else value
