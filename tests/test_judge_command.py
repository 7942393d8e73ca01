"""A judge is fitted, judges a set and is corrected; what it reads of an episode is read apart."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_episode_embedder import embedder, recorded  # noqa: F401
from test_reward_parts import embedded
from test_towers import make_clip

from touchgoal.control.features import (
    FRONT,
    TACTILE_LEFT,
    TACTILE_RIGHT,
    TCP_POSE,
    TRUTH_CONTACT,
    WRENCH,
    WRIST,
)
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeWriter
from touchgoal.launch.__main__ import main
from touchgoal.rewards.distance.normalizer import DistanceNormalizer
from touchgoal.rewards.features.embedder import EpisodeEmbedder
from touchgoal.rewards.features.embedding_cache import embed_end, embed_trajectory
from touchgoal.rewards.features.successful_ends import SuccessfulEnds
from touchgoal.rewards.judging.end_state import end_cost, end_costs, put_down
from touchgoal.rewards.judging.judge import Judge, fit_judge
from touchgoal.rewards.sources.episode_trajectories import EpisodeTrajectory
from touchgoal.rewards.sources.open_source import open_source
from touchgoal.runtime.errors import UserError


def test_no_success_fits_what_measures_it() -> None:
    """An odd success costs much, though it is among the successes; a lone object is left out."""
    usual = [embedded(seed) for seed in range(11)]
    odd, lone = embedded(11, slip=5e-3), replace(embedded(12), object="pear")
    judge = fit_judge([*usual, odd, lone], [embedded(13, slip=5e-3)], None)
    assert len(judge.successes) == 12 and len(judge.failures) == 1
    assert max(judge.successes) > 1.5 * np.sort(judge.successes)[-2]


def carried() -> Episode:
    """The hand rises 10 cm with what it holds and lowers it; at frame 33 of 40 it meets the table."""
    episode, rows = recorded(40, contact=8), np.arange(40)
    frames = {key: values.copy() for key, values in episode.frames.items()}
    frames[FRONT][:, 12:20] = (rows % 8 * 20)[:, None, None, None]
    pose = np.zeros((40, 7), np.float32)
    pose[:, 2] = np.interp(rows, (10, 20, 35), (0.0, 0.1, 0.0))
    wrench = np.zeros((40, 6), np.float32)
    wrench[33:, 2] = 3
    frames[TACTILE_LEFT][33:, 80:160] //= 2
    return replace(episode, frames={**frames, TCP_POSE: pose, WRENCH: wrench})


def test_an_end_is_judged_alike_from_less(embedder: EpisodeEmbedder, tmp_path: Path) -> None:  # noqa: F811
    EpisodeWriter(tmp_path / "set").append(carried())
    trajectory = open_source(tmp_path / "set", "front").trajectories[0]
    assert isinstance(trajectory, EpisodeTrajectory)
    less, again = embed_end(embedder, trajectory), embed_end(embedder, trajectory)
    whole = embed_trajectory(embedder, trajectory)
    assert put_down(whole.features, 20) == put_down(less.features, 20) == 33
    assert len(less.features["image"]) == 1
    units = {"front": 1e-3, "object": 1e-5, "held": 0.3}
    goal = {k: whole.features[k][35:36] for k in ("front", "touch", "held", "wrench")}
    expected = end_costs(whole.features, 20, goal, units, None)
    assert expected["object"] > 0.1 and expected["front"] > 0.1
    ends, of_less = SuccessfulEnds.of([whole]).features, SuccessfulEnds.of([less]).features
    assert {k: len(v) for k, v in of_less.items()} == dict.fromkeys(ends, 1)
    for one in (less, again):
        assert end_costs(one.features, 20, goal, units, None) == pytest.approx(expected, abs=1e-3)


def test_a_hand_that_lets_go_is_judged_by_what_it_carried(embedder: EpisodeEmbedder) -> None:  # noqa: F811
    """Empty hands are alike at the end: what they carried, and how it slipped, is read before."""
    kept = carried()
    frames = {key: values.copy() for key, values in kept.frames.items()}
    for key in (TACTILE_LEFT, TACTILE_RIGHT, TRUTH_CONTACT):
        frames[key][36:] = frames[key][0]
    other = {**frames, TACTILE_LEFT: np.roll(frames[TACTILE_LEFT], 60, axis=2)}
    unfelt = {
        **frames,
        TACTILE_LEFT: frames[TACTILE_LEFT].copy(),
        WRENCH: np.zeros((40, 6), np.float32),
    }
    unfelt[TACTILE_LEFT][33:36] = unfelt[TACTILE_LEFT][32]  # put down too softly to be felt
    let_go, holds, wrong, softly = (
        embedder.embed_chunks([replace(kept, frames=f)], 20, "one")
        for f in (frames, kept.frames, other, unfelt)
    )
    ends = SuccessfulEnds.of([let_go, let_go]).features
    assert "carried_touch" in ends and "carried_touch" not in SuccessfulEnds.of([holds]).features
    units = {"object": 1e-5, "slip": 2e-4, "held": 0.3}
    right, off = (end_costs(e.features, 20, ends, units, None) for e in (let_go, wrong))
    assert right["object"] == pytest.approx(0, abs=1e-6) and right["slip"] < 0.35
    assert off["object"] > 0.5 and right["held"] == off["held"] == 0
    soft = end_costs(softly.features, 20, ends, units, None)
    assert soft["object"] == pytest.approx(0, abs=1e-6) and soft["slip"] < 0.35


def test_fitted_judged_and_corrected(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Images alone; a person's word stays when the set is judged again; camera and towers are kept."""
    pytest.importorskip("transformers")
    episode, fit = recorded(), ("fit-normalizer", "set", "--judge", "--out")
    for k in range(10):
        front = episode.frames[FRONT] + np.uint8(k)
        if k < 9:  # done: half of the image has changed
            front[6:, :, 16:] = (250, 200 - k, 30)
        meta = {"success": k != 9, "object": "cup"}
        EpisodeWriter(here / "set").append(
            Episode({FRONT: front, WRIST: front[:, ::-1].copy()}, "pick", meta)
        )
        if k == 7:
            with pytest.raises(SystemExit, match="at least 9 successes.*; there are 8"):
                main([*fit, "few"])
    main([*fit, "fit"])
    assert "of 9 successes and 1 failures" in capsys.readouterr().out
    judge = ["judge", "set", "--judge", "fit", "--out"]
    main([*judge, "out"])
    assert "verdicts agree with the recorded outcome" in capsys.readouterr().out
    told = json.loads(Path("set/judged.json").read_text())
    assert told["9"]["verdict"] == "failure" and told["9"]["reasons"]
    assert Path("out/judged.html").read_text().count("<img") == 20
    path = Path("fit/normalizer.json")  # of images that separate nothing
    replace(DistanceNormalizer.load(path), start={}, goal={}).save(path)
    main([*judge, "parts"])
    assert Path("parts/judged.csv").read_text() == Path("out/judged.csv").read_text()
    with pytest.raises(SystemExit, match="run it in a terminal"):
        main([*judge, "x", "--correct"])
    answers = iter(["f", "", "q"])
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda _: next(answers))
    main([*judge, "corrected", "--correct"])
    assert len(json.loads(Path("fit/judge.json").read_text())["failures"]) == 2
    main([*judge, "again"])
    told = json.loads(Path("set/judged.json").read_text())
    assert [one["verdict"] for one in told.values() if one["by"] == "person"] == ["failure"]
    main([*fit, "clip", "--towers", str(make_clip(here / "towers")), "--camera", "wrist"])
    assert json.loads(Path("clip/judge.json").read_text())["towers"].startswith(
        str(here / "towers")
    )
    main(["judge", "set", "--judge", "clip", "--out", "seen"])
    assert json.loads(Path("set/judged.json").read_text())["9"]["verdict"] == "failure"


def test_the_limits_keep_their_bounds_and_doubt_without_failures(tmp_path: Path) -> None:
    """Over exchangeable costs at most a tenth of either side is called the other, and hardly less."""
    rng, trials, wrong = np.random.default_rng(0), 2000, [0, 0]
    for _ in range(trials):
        good, bad = rng.gamma(2.0, 0.1, 31), 0.2 + rng.gamma(2.0, 0.1, 31)
        judge = Judge(tuple(good[1:].tolist()), tuple(bad[1:].tolist()))
        accept, refuse = judge.limits
        if accept < refuse:  # else one limit lies between both
            wrong[0] += judge.verdict(float(good[0])) == "failure"
            wrong[1] += judge.verdict(float(bad[0])) == "success"
    assert 0.05 * trials < min(wrong) and max(wrong) < 0.12 * trials
    without = Judge(tuple(np.linspace(0.1, 0.9, 9)))
    assert without.verdict(0.8) == "unsure" and "unknown: show it 20" in str(without)
    without.corrected(0.95, success=False).save(tmp_path / "judge.json")
    assert Judge.load(tmp_path / "judge.json").failures == (0.95,)
    with pytest.raises(UserError, match="at least 9 successes"):
        Judge((0.1,) * 8)
    (tmp_path / "judge.json").write_text("[]")
    with pytest.raises(UserError, match="is no judge: fit one"):
        Judge.load(tmp_path / "judge.json")


def test_pressing_and_a_missing_put_down_cost() -> None:
    """Pressing counts above 5 N and above what successes do, one-sidedly; nothing put down counts in full."""
    felt = {"wrench": np.zeros((12, 6), np.float32), "held": np.ones((12, 1), bool)}
    goal = {
        "wrench": felt["wrench"][:2].copy(),
        "held": felt["held"][:2],
        "put_down": np.ones(2, bool),
    }
    costs = {}
    for newtons in (0, 4, 9, 40):
        felt["wrench"][:, 2] = newtons
        costs[newtons] = end_costs(felt, 20, goal, {"held": 0.3}, None)
    assert costs[0]["put_down"] == 1
    assert (
        costs[0]["press"] == costs[4]["press"] == 0 < costs[9]["press"] < 0.3 < costs[40]["press"]
    )


def test_the_scene_is_compared_cell_by_cell_with_any_success() -> None:
    """Every cell is known from one success or another: no cost; one unknown cell of twenty: its cost."""
    rng = np.random.default_rng(0)
    known = rng.normal(size=(2, 8, 4, 5)).astype(np.float16)
    mixed = known[:1].copy()
    mixed[0, :, 2:] = known[1, :, 2:]
    goal = {"wrist": np.ones((1, 4), np.float32) / 2, "wrist_map": known[:1], "scene_map": known}
    seen = {"wrist": goal["wrist"], "wrist_map": mixed}
    assert end_costs(seen, 20, goal, {"wrist": 0.1}, None)["scene"] == pytest.approx(0, abs=1e-5)
    mixed[0, :, 1, 1] *= -1
    cost = end_costs(seen, 20, goal, {"wrist": 0.1}, None)
    assert cost["scene"] > 0.5 and cost["wrist"] == pytest.approx(0, abs=1e-6)
    assert end_cost(cost) == pytest.approx(np.sqrt(0.4) * cost["scene"])
