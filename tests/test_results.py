"""README and docs quote what was measured: every figure in them stands in benchmarks/results."""

import re

import pytest

from touchgoal.benchmarks import results
from touchgoal.benchmarks.quoted import QUOTED

RECORDS = sorted(path.stem for path in results.FOLDER.glob("*.json"))


@pytest.mark.parametrize("page", results.pages(), ids=lambda page: page.name)
def test_pages_quote_the_records(page) -> None:
    """`python -m touchgoal.benchmarks.results` has been run since the last measurement."""
    assert page.read_text() == results.rendered(page.read_text())


def test_every_result_is_recorded_and_shown() -> None:
    assert sorted(QUOTED) == RECORDS
    shown = {
        name
        for page in results.pages()
        for name in re.findall(r"<!-- result: ([\w-]+) -->", page.read_text())
    }
    assert shown == set(QUOTED), "each in full somewhere in docs/"
    assert sum(bool(quoted.claim) for quoted in QUOTED.values()) <= 10


@pytest.mark.parametrize("name", RECORDS)
def test_records_are_complete(name: str) -> None:
    record = results.load(name)
    assert record["command"] == QUOTED[name].command
    assert record["printed"] and record["measured"] and record["hardware"]
    if record["metrics"] is not None:  # None: measured before records were kept
        assert record["headline"] == QUOTED[name].headline(record["metrics"])
    else:
        assert record["measured"].startswith("before 2026-11-22")
