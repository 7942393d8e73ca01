"""Shipped records are what the pages say, and the commands that make what ships."""

from pathlib import Path

import pytest

from benchmarks import records
from benchmarks.__main__ import main
from benchmarks.records import QUOTED
from touchgoal.launch import __main__ as command
from touchgoal.launch import make_policy
from touchgoal.launch.make_policy import Config


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


@pytest.mark.parametrize("task", ["pick-place", "bead-maze"])
def test_no_two_recordings_share_a_seed(task: str) -> None:
    """A shared seed would be skipped without a word."""
    steps_of = make_policy._pick_place if task == "pick-place" else make_policy._bead_maze
    steps = steps_of(Config(task=task, demonstrations=20_000, corrections=3000), Path())  # pyright: ignore[reportArgumentType]
    recorded, asked = set(), 0
    for step in steps:
        if step[0] == "collect-demos":
            episodes, seed = (int(step[step.index(o) + 1]) for o in ("--episodes", "--seed"))
            recorded |= set(range(seed, seed + episodes))
            asked += episodes
    assert len(recorded) == asked > 28_000


@pytest.mark.parametrize("left", ["config.json", "checkpoint.pt"])
def test_a_training_without_a_finished_epoch_begins_anew(
    left: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = []
    monkeypatch.setattr(command, "read_options", lambda _, options: given.extend(options) or 1 / 0)
    folder = tmp_path / "round-1"
    folder.mkdir()
    (folder / left).touch()
    with pytest.raises(ZeroDivisionError):  # here it would begin
        make_policy._run(["train-policy", "--out", str(folder)])
    assert folder.exists() == ("--resume" in given) == (left == "checkpoint.pt")
