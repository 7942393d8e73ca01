"""Steps of make-policy: seeds that do not overlap, and resumption."""

from pathlib import Path

import pytest

from touchgoal.launch import __main__ as command
from touchgoal.launch import make_policy
from touchgoal.launch.make_policy import Config
from touchgoal.runtime.errors import UserError


@pytest.mark.parametrize("task", ["pick-place", "bead-maze"])
def test_no_two_recordings_share_a_seed(task: str) -> None:
    """However many demonstrations and corrections are asked for: a shared seed would be skipped."""
    steps_of = make_policy._pick_place if task == "pick-place" else make_policy._bead_maze
    steps = steps_of(Config(task=task, demonstrations=20_000, corrections=3000), Path())  # pyright: ignore[reportArgumentType]
    recorded, asked = set(), 0
    for step in steps:
        if step[0] == "collect-demos":
            episodes, seed = (int(step[step.index(o) + 1]) for o in ("--episodes", "--seed"))
            recorded |= set(range(seed, seed + episodes))
            asked += episodes
    assert len(recorded) == asked > 28_000


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rounds": 9}, "--rounds is 9; pick-place has at most 5"),
        ({"rounds": 4, "task": "bead-maze"}, "--rounds is 4; bead-maze has at most 3"),
        ({"corrections": 100_001}, "--corrections is 100001; at most 100000"),
    ],
)
def test_more_than_there_are_is_refused(options: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=message):
        make_policy.main(Config(out=tmp_path / "made", **options))
    assert not (tmp_path / "made").exists()


def test_a_training_without_a_finished_epoch_begins_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = []

    def read_options(name: str, options: list[str]):
        given.append(options)
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "read_options", read_options)
    folder = tmp_path / "round-1"
    folder.mkdir()
    (folder / "config.json").touch()
    step = ["train-policy", "--out", str(folder)]
    with pytest.raises(KeyboardInterrupt):
        make_policy._run(step)
    assert not folder.exists()
    folder.mkdir()
    (folder / "checkpoint.pt").touch()
    with pytest.raises(KeyboardInterrupt):
        make_policy._run(step)
    assert folder.exists() and given == [step[1:], [*step[1:], "--resume"]]
