"""README and docs quote what was measured: every figure in them stands in benchmarks/results."""

import pytest

from touchgoal.benchmarks import records
from touchgoal.benchmarks.records import QUOTED
from touchgoal.launch.__main__ import main


@pytest.mark.parametrize("page", records.pages(), ids=lambda page: page.name)
def test_pages_quote_the_records(page) -> None:
    """`python -m touchgoal.benchmarks.records` has been run since the last measurement."""
    assert page.read_text() == records.render(page.read_text())


def test_every_record_is_quoted() -> None:
    assert sorted(QUOTED) == sorted(path.stem for path in records.FOLDER.glob("*.json"))
    assert sum(quoted.in_readme for quoted in QUOTED.values()) <= 8


@pytest.mark.parametrize("name", sorted(QUOTED))
def test_a_record_is_complete_and_printed_by_its_benchmark(name: str, capsys) -> None:
    record = records.load_record(name)
    assert list(record) == ["command", "measured", "hardware", "printed", "metrics"]
    assert record["command"] == QUOTED[name].command and records.headline(name)
    with pytest.raises(SystemExit):
        main(["benchmark", name, "--recorded"])
    printed = capsys.readouterr().out
    assert all(line in printed for line in record["printed"])


def test_a_measured_record_has_the_schema_of_all(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(records, "FOLDER", tmp_path)
    metrics = {"successes": 1, "trials": 2, "hardware": "2 cores"}
    records.write_record("pick-place", QUOTED["pick-place"].command, ["a table"], metrics)
    assert list(records.load_record("pick-place")) == [
        "command", "measured", "hardware", "printed", "metrics",
    ]  # fmt: skip
    assert records.headline("pick-place").startswith("1/2 [")
