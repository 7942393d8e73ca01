"""Rows of text as the lines of a table."""

from collections.abc import Sequence


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows as lines, the first column to the left, the others to the right."""
    width, *widths = (max(map(len, column)) for column in zip(*rows, strict=True))
    return [
        f"{first:<{width}}" + "".join(f"{c:>{w + 2}}" for c, w in zip(rest, widths, strict=True))
        for first, *rest in rows
    ]
