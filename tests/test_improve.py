"""Improvement of a policy by its own runs: what is done is skipped, and no simulator's verdict is read."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_process import run

from touchgoal.control import features as ft
from touchgoal.episodes.outcomes.judged import JudgedOutcome, read_judged
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.launch import improve as command
from touchgoal.policies.training import improve
from touchgoal.policies.training.improve import Improvement, simulation_of
from touchgoal.policies.training.training_data import choose_judged
from touchgoal.rewards.judging.judge import JUDGE, Judge
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.tasks import make_env


def episode(number: int, success: bool, told: bool = True) -> Episode:
    state = np.full((3, 15), number, np.float32)
    frames = {ft.STATE: state, ft.ACTION: np.zeros((3, 8), np.float32)}
    truth = {ft.TRUTH_SUCCESS: np.full((3, 1), success)} if told else {}
    return Episode(frames | truth, "put", {"task": "put", "seed": number, "success": success})


@pytest.fixture
def data(tmp_path: Path) -> Path:
    writer = EpisodeWriter(tmp_path / "data")
    for number, success in ((100, True), (101, False), (102, True)):
        writer.append(episode(number, success))
    writer.close()
    return tmp_path / "data"


def improvement(out: Path, data: Path, wrong: bool = False, killed: int = -1) -> Improvement:
    """Return one whose judge accepts even numbers; the simulator says the same, or, `wrong`, the opposite."""

    def record(policy: Path, root: Path, numbers: range) -> None:
        writer = EpisodeWriter(root)
        for n in numbers:
            if n == killed:
                raise KeyboardInterrupt
            writer.append(
                episode(n + 1000 * len((policy / "rows").read_text()), (n % 2 == 0) != wrong)
            )
        writer.close()

    def label(episodes: EpisodeSet) -> dict[int, JudgedOutcome]:
        last = [episodes.read(i, [ft.STATE]).frames[ft.STATE][-1, 0] for i in range(len(episodes))]
        return {i: JudgedOutcome("failure" if s % 2 else "success") for i, s in enumerate(last)}

    def train(root: Path, folder: Path) -> None:
        (folder / "policy").mkdir(parents=True)
        (folder / "policy" / "rows").write_text(str(choose_judged(EpisodeSet(root)).rows))

    return Improvement(out, data, 4, record, label, train)


def accepted(out: Path) -> list[str]:
    return [(out / f"round-{n}" / "policy" / "rows").read_text() for n in range(3)]


def test_an_interrupted_improvement_goes_on_to_the_same_result(tmp_path: Path, data: Path) -> None:
    whole = list(improvement(tmp_path / "a", data).rounds(2))
    with pytest.raises(KeyboardInterrupt):
        list(improvement(tmp_path / "b", data, killed=6).rounds(2))
    assert len(EpisodeSet(tmp_path / "b" / "episodes")) == 3 + 6
    assert list(improvement(tmp_path / "b", data).rounds(2)) == whole
    assert accepted(tmp_path / "a") == accepted(tmp_path / "b")
    assert accepted(tmp_path / "a")[::2] == ["[0, 2]", "[0, 2, 3, 5, 7, 9]"], (
        "demonstrations and runs"
    )
    seen = [EpisodeSet(tmp_path / name / "episodes") for name in "ab"]
    assert len({s.checksum for s in seen}) == 1
    assert str(whole[0].rates["true"]).startswith("2/4"), "beside the judged rate"


def test_no_decision_reads_the_simulators_verdict(
    tmp_path: Path, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    list(improvement(tmp_path / "right", data).rounds(2))
    read, meta = EpisodeSet.read, EpisodeSet.meta

    def guarded(self: EpisodeSet, i: int, keys: Any = None) -> Episode:
        assert not [key for key in keys or self.features if key.startswith("truth.")]
        return read(self, i, keys)

    monkeypatch.setattr(improve, "true_outcomes", lambda *_: None)  # the report alone
    monkeypatch.setattr(EpisodeSet, "read", guarded)
    told = "success", "failures", "outcome"
    monkeypatch.setattr(EpisodeSet, "meta", lambda self, i: {
        k: v for k, v in meta(self, i).items() if i < 3 or k not in told})  # fmt: skip
    list(improvement(tmp_path / "wrong", data, wrong=True).rounds(2))
    assert accepted(tmp_path / "wrong") == accepted(tmp_path / "right")


def test_a_success_ends_no_run() -> None:
    for ends in (True, False):
        env = make_env(PickPlaceConfig(cameras=(), tactile=False, ends_by_success=ends))
        env.reset(seed=0)
        env.evaluate = lambda: (1.0, True)
        _, _, terminated, _, info = env.step(np.zeros(8))
        assert terminated == ends and info[ft.TRUTH_SUCCESS]
        env.close()


@pytest.mark.slow
@pytest.mark.usefixtures("in_process")
def test_improve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def label(folder: Path, episodes: EpisodeSet) -> dict[int, JudgedOutcome]:
        return {i: JudgedOutcome("success" if i % 2 else "unsure") for i in range(len(episodes))}

    monkeypatch.setattr(command, "judge_set", label)
    Judge((0.1,) * 9).save(tmp_path / JUDGE)
    record = "collect-demos --episodes 1 --env.objects cork --env.control-hz 10 --env.no-tactile --env.cameras --workers 1"
    run(*record.split(), "--out", tmp_path / "demos")
    run(*record.split(), "--seed", 1, "--out", tmp_path / "val")
    demos, val = (tmp_path / name / "episodes" for name in ("demos", "val"))
    env = simulation_of(EpisodeSet(demos))
    assert isinstance(env, PickPlaceConfig) and env.objects == ("cork",) and not env.ends_by_success
    run("improve", "--data", demos, "--validation", val, "--judge", tmp_path, "--rounds", 1, "--episodes", 2, "--workers", 1,
        "--train=--head tiny --representation delta --train.epochs 1 --workers 1", "--out", tmp_path / "out")  # fmt: skip
    assert "1/2 [0.09, 0.91]" in capsys.readouterr().out
    episodes = EpisodeSet(tmp_path / "out" / "episodes")
    assert choose_judged(episodes).rows == [0, 1] and read_judged(episodes)[2].verdict == "unsure"
    assert episodes.lengths[1] == 10 * 8 + 1 + 10, "to the time limit, then a second of rest"
    found = json.loads((tmp_path / "out" / "metrics.json").read_text())["rounds"]
    assert found[0]["true"] == [False, False] and (tmp_path / "out" / "success.png").is_file()
