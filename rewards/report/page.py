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
from touchgoal.rewards.report.thumbnails import last_of
from touchgoal.runtime.atomic_write import write_file

PAGE = "report.html"
PER_PAGE = 100  # trajectories
_MOST_POINTS = 600  # of a curve in a page; a longer one is drawn by evenly spaced frames
_FILES = Path(__file__).parent / "page_files"
_WORDS = {"source": "trajectory", "object": "object", "outcome": "outcome"}
_WHOLE = ("t_drop_50", "contact_lag", "peaks")  # metrics that count


def write_pages(
    records: Sequence[Path], facts: Sequence[Facts], out: Path, tables: Sequence[str]
) -> Path:
    """Write the pages of all records; return the first one.

    `tables` are printed above the table of trajectories, each with its title as its first line.
    """
    groups = [range(i, min(i + PER_PAGE, len(facts))) for i in range(0, len(facts), PER_PAGE)]
    names = [PAGE] if len(groups) == 1 else [f"report_{k + 1:03d}.html" for k in range(len(groups))]
    thumbs: list[str] = []
    for name, group in zip(names, groups, strict=True):
        loaded = [Record.load(records[i]) for i in group]
        thumbs += [_thumb(record) for record in loaded]
        some = [record.facts for record in loaded]
        links = names if len(groups) > 1 else []
        content = _content(facts, [_viewed(record) for record in loaded])
        write_file(out / name, _fill(content, facts, some, links, tables).encode())
    if len(groups) > 1:
        page_of = [name for name, group in zip(names, groups, strict=True) for _ in group]
        rows = [
            _row(f) | {"thumb": thumb, "page": f"{page}#{f.name}"}
            for f, thumb, page in zip(facts, thumbs, page_of, strict=True)
        ]
        page = _fill(_content(facts, rows), facts, facts, names, tables)
        write_file(out / PAGE, page.encode())
    return out / PAGE


def _fill(
    content: Mapping[str, Any],
    facts: Sequence[Facts],
    some: Sequence[Facts],
    pages: Sequence[str],
    tables: Sequence[str],
) -> str:
    goals = sorted({goal for f in facts for goal in f.goal.values()})
    listed = ", ".join(goals[:3]) + (f" and {len(goals) - 3} more" if len(goals) > 3 else "")
    frames = sum(f.frames for f in some)
    links = [f'<a href="{PAGE}">all</a>'] if pages else []
    links += [f'<a href="{page}">{k + 1}</a>' for k, page in enumerate(pages)]
    number = f"{len(some)} trajectories" if len(some) > 1 else "1 trajectory"
    return Template((_FILES / "page.html").read_text()).substitute(
        title=html.escape(f"Reward curves: {some[0].source}"),
        heading="Reward curves",
        subheading=html.escape(f"{number}, {frames:,} frames · goal: {listed} · {facts[0].unit}"),
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


def _content(facts: Sequence[Facts], episodes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    names = list(dict.fromkeys(name for f in facts for name in f.measured))
    words = [{"key": key, "label": label, "word": True} for key, label in _WORDS.items()]
    used = [w for w in words if any(getattr(f, w["key"]) for f in facts)]
    metrics = [
        {
            "key": field,
            "label": header,
            "meaning": meaning,
            "metric": True,
            "digits": 0 if field in _WHOLE else 2,
        }
        for header, (field, meaning) in COLUMNS.items()
        if any(m[field] is not None for f in facts for m in f.measured.values())
    ]
    return {
        "curves": names,
        "main": main_curve(names),
        "styles": line_styles(names),
        "unit": facts[0].unit,
        "levels": reference_levels(names, facts[0].normalised),
        "columns": [*used, {"key": "frames", "label": "frames", "digits": 0}, *metrics],
        "episodes": episodes,
    }


def _row(facts: Facts) -> dict[str, Any]:
    fields = {field for field, _ in COLUMNS.values()}
    return {
        "name": facts.name,
        "source": facts.source,
        "object": facts.object,
        "outcome": facts.outcome,
        "frames": facts.frames,
        "metrics": {
            name: {k: _short(v) for k, v in values.items() if k in fields}
            for name, values in facts.measured.items()
        },
    }


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


def _thumb(record: Record) -> str:
    sheet = next(iter(record.sheets.values()))
    return data_uri(last_of(sheet, len(record.facts.shown)))


def data_uri(jpeg: bytes) -> str:
    """Return a JPEG as an address that holds it."""
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}"


def _short(value: float | int | None) -> float | int | None:
    return round(value, 4) if isinstance(value, float) else value
