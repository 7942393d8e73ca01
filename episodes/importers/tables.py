"""Tables and images of published sets of touches."""

import csv
from collections.abc import Iterable
from pathlib import Path

from touchgoal.runtime.errors import UserError


def read_table(table: Path, columns: Iterable[str]) -> list[dict[str, str]]:
    """Read the rows of a CSV file; UserError if it is missing, empty or lacks a column."""
    if not table.is_file():
        raise UserError(f"no {table.name} in {table.parent}: give the folder as it is published")
    with table.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        if missing := [name for name in columns if name not in (reader.fieldnames or ())]:
            raise UserError(f"{table} lacks the column {missing[0]}")
        rows = list(reader)
    if not rows:
        raise UserError(f"{table} has no rows: fetch it again")
    return rows


def check_there(paths: Iterable[Path], table: Path) -> None:
    """Raise UserError for the first file that a table names and that is missing."""
    if absent := next((path for path in paths if not path.is_file()), None):
        raise UserError(f"{table} names {absent}, which is not there: fetch the set again")
