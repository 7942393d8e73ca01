"""Shipped records are what the pages say, and the commands that make what ships."""

import pytest
from documented_commands import recipes

from benchmarks import records
from benchmarks.__main__ import main
from benchmarks.records import QUOTED
from touchgoal.runtime import seeds

RANGES = (seeds.TRAINING, seeds.VALIDATION, seeds.DISTURBED, *seeds.CORRECTIONS)


@pytest.mark.parametrize("page", records.pages(), ids=lambda page: page.name)
def test_pages_quote_the_records(page) -> None:
    """`python -m benchmarks.records` has been run since the last measurement."""
    assert page.read_text() == records.render(page.read_text())


def test_every_record_is_quoted() -> None:
    assert sorted(QUOTED) == sorted(path.stem for path in records.FOLDER.glob("*.json"))
    assert sum(quoted.in_readme for quoted in QUOTED.values()) <= 8


@pytest.mark.parametrize("name", sorted(QUOTED))
def test_a_record_is_complete_and_printed_by_its_benchmark(name: str, capsys) -> None:
    record = records.load_record(name)
    assert list(record) == ["command", "measured", "hardware", "printed", "metrics"]
    assert record["command"] == QUOTED[name].command and records.headline(name)
    main([name, "--recorded"])
    printed = capsys.readouterr().out
    assert all(line in printed for line in record["printed"])


@pytest.mark.parametrize("target", ["pick-place-policy", "maze-policy"])
def test_no_two_recordings_share_a_seed(target: str) -> None:
    """A shared seed would be skipped without a word."""
    recorded, asked = set(), 0
    for step in recipes(target):
        if step[0] == "collect-demos":
            episodes, seed = (int(step[step.index(o) + 1]) for o in ("--episodes", "--seed"))
            assert any(seed == r.start and episodes <= r.count for r in RANGES)
            recorded |= set(range(seed, seed + episodes))
            asked += episodes
    assert len(recorded) == asked > 400
