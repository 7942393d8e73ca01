"""Rows and layout of a recording, as rerun itself reads them."""

from collections import Counter
from pathlib import Path


def rerun_rows(path: Path) -> Counter[str]:
    """Return the number of rows of each entity path."""
    from rerun.chunk import RrdReader  # pyright: ignore[reportMissingImports]

    rows: Counter[str] = Counter()
    for chunk in RrdReader(path).stream():
        rows[chunk.entity_path.replace("\\", "")] += chunk.num_rows
    return rows


def rerun_views(path: Path) -> set[str]:
    """Return the names of the views in the layout."""
    from rerun.chunk import RrdReader  # pyright: ignore[reportMissingImports]

    reader, names = RrdReader(path), "ViewBlueprint:display_name"
    layout = (chunk.to_record_batch() for chunk in reader.stream(store=reader.blueprints()[-1]))
    return {
        name
        for batch in layout
        if names in batch.schema.names
        for row in batch.column(names).to_pylist()
        for name in row
    }
