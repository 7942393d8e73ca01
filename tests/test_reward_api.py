"""One object measures arrays, sets and runs; what is checked before any encoder is loaded."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from test_episode_embedder import recorded
from toy_towers import PaintTowers

from touchgoal.control.cell.cell_file import EXAMPLES, read_cell_file
from touchgoal.control.features import (
    FRONT,
    STATE,
    TACTILE,
    TACTILE_LEFT,
    TACTILE_RIGHT,
    TRUTH_CONTACT,
    TRUTH_START,
)
from touchgoal.encoders import pretrained
from touchgoal.encoders.alignment.touch_encoder import TouchEncoder, TouchEncoderConfig
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder, PooledEncoderConfig
from touchgoal.encoders.backbones.vit import PRESETS
from touchgoal.encoders.pretrained import save
from touchgoal.episodes.media import write_video
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.launch.__main__ import main
from touchgoal.rewards.distance.cost import compute_curves
from touchgoal.rewards.distance.normalizer import DistanceNormalizer
from touchgoal.rewards.features.embedder import EpisodeEmbedder
from touchgoal.rewards.features.successful_ends import GOAL_FILE, SuccessfulEnds
from touchgoal.rewards.goals import GoalImage, Inputs, Sentence, assign_goals, parse_goal
from touchgoal.rewards.judging.end_state import end_cost
from touchgoal.rewards.judging.judge import JUDGE, Judge
from touchgoal.rewards.online import CostMeter, OnlineCost, load_cell_cost
from touchgoal.rewards.prepared_reward import PreparedReward
from touchgoal.rewards.report.plot import plot
from touchgoal.rewards.reward import Reward
from touchgoal.runtime.errors import UserError

EPISODE = recorded()
IMAGES = EPISODE.frames[FRONT]
STORED = json.loads((Path(__file__).parent / "reward_costs.json").read_text())
TOUCH = {"left": EPISODE.frames[TACTILE_LEFT], "right": EPISODE.frames[TACTILE_RIGHT]}


@pytest.fixture(scope="module")
def encoder() -> TouchEncoder:
    torch.manual_seed(0)
    config = TouchEncoderConfig.for_towers(PRESETS["tiny"], PaintTowers(), "gelsight_mini", 16)
    return TouchEncoder(config)


def test_curve_of_arrays(encoder: TouchEncoder) -> None:
    both = {"encoder": encoder, "towers": PaintTowers()}
    curves = Reward(("last", "a hard ball"), **both)(images=IMAGES, tactile=TOUCH)
    assert curves.costs.keys() == {"image", "tactile", "text"}
    for name, cost in curves.costs.items():
        assert cost.shape == (12,) and curves.rewards[name] == pytest.approx(-cost)
        discounted = 0.9 ** (1 / curves.fps) * cost[1:]  # a second
        assert curves.potential_rewards(0.9)[name][1:] == pytest.approx(cost[:-1] - discounted)
        assert curves.potential_rewards()[name].sum() == pytest.approx(cost[0] - cost[-1])
    for name in ("image", "tactile"):
        assert curves.costs[name][0] > 1e-4 and curves.costs[name][-1] == pytest.approx(0, abs=1e-6)
    third = Reward(3, **both)(images=IMAGES, tactile=TOUCH)
    assert third.costs["image"].argmin() == 3 and third.same_episode == {"image", "tactile"}


def test_one_reward_loads_one_encoder(run_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over arrays, a set, and an episode of it."""
    pytest.importorskip("transformers")
    load, loaded = pretrained.load_encoder, []
    monkeypatch.setattr(pretrained, "load_encoder", lambda *a: loaded.append(a) or load(*a))
    reward = Reward(f"bank:{run_folder / 'episodes'}", normalizer="none")
    curves = reward(images=IMAGES, tactile=TOUCH)
    assert curves.costs.keys() == {"image", "tactile"}
    episodes = EpisodeSet(run_folder / "episodes")
    of_set = reward(episodes)
    assert [len(c) for c in of_set] == [12, 12, 12]
    one = reward(episodes.read(2)).costs["tactile"]
    assert one == pytest.approx(of_set[2].costs["tactile"], abs=1e-6)
    assert len(loaded) == 1


@pytest.mark.gpu
def test_a_gpu_gives_the_same_curves() -> None:
    on_cpu, on_gpu = (
        Reward(("last", "a hard ball"), device=device)(images=IMAGES, tactile=TOUCH).costs
        for device in ("cpu", "cuda")
    )
    for name, cost in on_cpu.items():
        assert on_gpu[name] == pytest.approx(cost, abs=1e-3)


def test_goals_as_arrays_are_those_of_the_same_frame(encoder: TouchEncoder) -> None:
    both = {"encoder": encoder, "towers": PaintTowers()}
    frame = Reward(9, **both)(images=IMAGES, tactile=TOUCH)
    arrays = {"image": IMAGES[9], **{side: images[9] for side, images in TOUCH.items()}}
    given = Reward(arrays, **both)(images=IMAGES, tactile=TOUCH)
    for name in ("image", "tactile"):
        assert given.costs[name] == pytest.approx(frame.costs[name], abs=1e-6)
    assert not given.same_episode
    image = Reward(IMAGES[9], towers=PaintTowers())(images=IMAGES)
    assert image.costs["image"] == pytest.approx(frame.costs["image"], abs=1e-6)
    touch = Reward("last", **both)(tactile={"left": TOUCH["left"]})
    assert touch.costs.keys() == {"tactile"}


@pytest.mark.parametrize(
    ("options", "arrays", "message"),
    [
        ({}, {}, "nothing to measure"),
        ({}, {"images": IMAGES / 255}, "images must be RGB .* not of float64"),
        ({}, {"images": IMAGES[:1]}, "at least 2 frames"),
        ({}, {"images": IMAGES, "tactile": {"left": IMAGES[:3]}}, "images 12, left 3"),
        ({"goal": {"left": IMAGES[0]}}, {"images": IMAGES}, "must be the trajectory's"),
        ({"encoder": "nobody"}, {"tactile": TOUCH}, "no touch encoder 'nobody'"),
        ({"goal": "force:3"}, {"images": IMAGES}, "applies to force, but this source has image"),
    ],
)
def test_a_mistake_is_one_line(
    options: dict[str, Any], arrays: dict[str, Any], message: str
) -> None:
    with pytest.raises(UserError, match=message) as error:
        Reward(**options)(**arrays)
    assert "\n" not in str(error.value)


def _stripes(shift: int) -> np.ndarray:
    """Thin upright stripes that turn into broad level ones."""
    rows, columns = np.mgrid[:64, :64]
    thin, broad = 200.0 * (columns // 2 % 2), 200.0 * ((rows + shift) // 16 % 2)
    share = np.linspace(0, 1, 12)[:, None, None]
    frames = ((1 - share) * thin + share * broad).astype(np.uint8)
    return np.repeat(frames[..., None], 3, axis=3)


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with episodes as an arm records them (no truth), and videos."""
    folder = tmp_path_factory.mktemp("run")
    writer = EpisodeWriter(folder / "episodes")
    frames = {k: v for k, v in EPISODE.frames.items() if k != TRUTH_CONTACT}
    for k, success in enumerate((True, True, False)):
        meta = {"sensor": "gelsight_mini", "success": success, "object": "cup"}
        seen = frames | {FRONT: frames[FRONT] + np.uint8(3 * k)}  # no two end alike
        writer.append(replace(EPISODE, frames=seen, meta=meta))
    for i in range(2):
        write_video(folder / f"{i}.mp4", _stripes(i), 20)
    write_video(folder / "one.mp4", IMAGES[:1], 20)
    Image.new("RGB", (1, 1)).save(folder / "tiny.png")
    return folder


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["0.mp4", "--goal", "frame:12"], "whose frames are 0 to 11"),
        (["0.mp4", "--goal", "image:tiny.png"], "is 1 x 1 pixels: give one as the camera takes"),
        (["0.mp4", "--fps", "10"], "states its own frame rate: leave --fps out"),
        (["0.mp4", "--device", "warp"], "--device warp cannot be used here"),
        (["0.mp4", "--goal", "episode:episodes#3"], "has episodes 0 to 2"),
        (["one.mp4"], "has one frame: a curve needs at least 2"),
        (["episodes", "--camera", "wrist"], "choose --camera observation.images.front"),
    ],
)
def test_mistakes_are_found_before_any_encoder_is_loaded(
    run_folder: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], message: str
) -> None:
    def loaded(*_: Any) -> None:
        raise AssertionError("the encoders were loaded first")

    monkeypatch.chdir(run_folder)
    monkeypatch.setattr("touchgoal.encoders.pretrained.load_encoder", loaded)
    monkeypatch.setattr("touchgoal.rewards.reward.load_towers", loaded)
    with pytest.raises(SystemExit, match=message):
        main(["reward-curves", *arguments, "--out", "out"])
    assert not (run_folder / "out").exists()


def costs_of(name: str) -> dict[str, list[float]]:
    rows = np.genfromtxt(f"{name}.csv", delimiter=",", names=True, deletechars="")
    costs = [column for column in rows.dtype.names or () if column.startswith("cost_")]
    return {column.removeprefix("cost_"): rows[column].tolist() for column in costs}


def test_foreign_data_are_drawn_raw_until_a_normalizer_is_fitted(
    run_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """The shipped normalizer is of the simulated scene; fit-normalizer makes one of any successes."""
    pytest.importorskip("transformers")
    monkeypatch.chdir(run_folder)
    for source in ("episodes", "0.mp4"):
        main(["reward-curves", source, "--out", f"raw-{source}"])
        assert "raw cosine distances, for" in capsys.readouterr().out
    [raw] = json.loads(Path("raw-0.mp4/metrics.json").read_text())
    assert raw["unit"] == "cosine distance to goal" and min(costs_of("raw-0.mp4/0")["image"]) >= 0
    of_episodes = json.loads(Path("raw-episodes/metrics.json").read_text())[0]
    assert set(of_episodes["measured"]) == {"image", "tactile"}

    main(["fit-normalizer", "episodes", "--modalities", "tactile", "--out", "touch"])
    fitted = DistanceNormalizer.load(Path("touch/normalizer.json"))
    assert fitted.episodes == 2 and fitted.scene == "recorded, not simulated"
    assert fitted.source.sensor == "gelsight_mini"
    assert set(fitted.start) == {"tactile", "tactile (same episode)"}
    with pytest.raises(SystemExit, match="does not apply here: it has no 'image .same episode.'"):
        main(["reward-curves", "episodes", "--goal", "last", "--normalizer",
              "touch/normalizer.json", "--out", "x"])  # fmt: skip

    main(["fit-normalizer", "0.mp4", "1.mp4", "--out", "videos"])
    main(["reward-curves", "0.mp4", "--normalizer", "videos/normalizer.json", "--out", "scaled"])
    [scaled] = json.loads(Path("scaled/metrics.json").read_text())
    assert scaled["unit"] == "distance to goal (normalised)"
    assert scaled["measured"]["fused"]["start"] == pytest.approx(1, abs=0.2)


def test_costs_are_those_on_record(
    run_folder: Path, here: Path, capsys: pytest.CaptureFixture
) -> None:
    """Images, touch and words, raw and as parts, by the command and in Python.

    The command normalises by the encoder's normalizer; so does Python when it is named.
    """
    pytest.importorskip("transformers")
    truth = {TRUTH_START: np.zeros((12, 7), np.float32)}
    meta = {"sensor": "gelsight_mini", "success": True, "object": "cup"}
    episode = replace(EPISODE, frames={**EPISODE.frames, **truth}, meta=meta)
    EpisodeWriter(here / "set").append(episode)
    goals = "--index", "0", "--goal", "last", "--goal", "text:a hard ball"
    main(["reward-curves", str(run_folder / "episodes"), *goals, "--out", "raw"])
    assert "the scene here is recorded, not simulated" in capsys.readouterr().out
    main(["reward-curves", "set", *goals, "--out", "parts"])
    main(["reward-curves", "set", *goals, "--plain", "--out", "plain"])
    raw, parts, plain = (costs_of(f"{out}/episode_000") for out in ("raw", "parts", "plain"))
    curves = Reward(("last", "a hard ball"), normalizer="encoder")(images=IMAGES, tactile=TOUCH)
    assert curves.unit == "distance to goal (normalised)" and "\n" not in repr(curves)
    pairs = (raw, STORED["raw"]), (parts | plain, STORED["normalised"]), (curves.costs, parts)
    for costs, expected in pairs:
        assert costs.keys() == expected.keys()
        for name, cost in costs.items():
            assert cost == pytest.approx(expected[name], abs=1e-3), name
    plot(curves).savefig("curves.png")
    assert Path("curves.png").stat().st_size > 10_000


def test_cost_during_a_run_is_raw_without_normalizer(encoder: TouchEncoder) -> None:
    tick = {FRONT: IMAGES[0], TACTILE_LEFT: TOUCH["left"][0], TACTILE_RIGHT: TOUCH["right"][0]}
    cost = OnlineCost(meter_of(encoder, None, IMAGES[9]))
    expected = Reward(IMAGES[9], towers=PaintTowers())(images=IMAGES).costs["image"][0]
    cost.begin(tick)
    assert cost.read().cost == pytest.approx(expected, abs=1e-6)
    cost.close()
    with pytest.raises(UserError, match="raw distances of several modalities"):
        meter_of(encoder, None, IMAGES[9], "soft")
    with pytest.raises(UserError, match="not known before the end"):
        meter_of(encoder, None, "last")


def meter_of(
    encoder: TouchEncoder, normalizer: DistanceNormalizer | None, *goals: np.ndarray | str
) -> CostMeter:
    inputs = Inputs("this run", FRONT, TACTILE, "gelsight_mini")
    reward = Reward(goals, encoder=encoder, towers=PaintTowers(), normalizer=normalizer)
    return CostMeter(reward.prepare(inputs))


def test_cost_during_a_run_is_that_of_its_recording(encoder: TouchEncoder) -> None:
    """Same frames, same cost, from the fifth tick on; one fingertip flickers in the first ticks."""
    noise = np.random.default_rng(1).integers(0, 30, (5, *TOUCH["left"].shape[1:]), dtype=np.uint8)
    left = np.concatenate([TOUCH["left"][:5] + noise, TOUCH["left"][5:]])
    embedder = EpisodeEmbedder(PaintTowers(), encoder)
    ends = {"image": 1.0, "text": 2.0}, {"image": 0.1, "text": 0.2}, {"front": 0.02}
    normalizer = DistanceNormalizer(*ends, {}, embedder.made_with, "recorded, not simulated", 3)
    goals = [GoalImage(IMAGES[9]), Sentence("soft")]
    frames = {FRONT: IMAGES, TACTILE_LEFT: left, TACTILE_RIGHT: TOUCH["right"]}
    recording = embedder.embed_chunks([Episode(frames=frames, task="", meta={})], 20.0, "recording")
    goal = embedder.embed_goal(assign_goals(goals, ("image", "tactile", "text")), recording)
    expected = compute_curves(recording, goal, normalizer).parts["fused"]
    assert np.ptp(expected) > 0.05
    meter = meter_of(encoder, normalizer, IMAGES[9], "soft")
    ticks = [{key: values[i] for key, values in frames.items()} for i in range(len(IMAGES))]
    during = [(meter.add(tick), meter.measure())[1] for tick in ticks]
    during = [reading.cost for reading in during if reading]
    np.testing.assert_allclose(during[4:], expected[4:], atol=1e-6)
    assert np.abs(during[0] - expected[0]) > 1e-4  # one frame is another background


def test_a_run_is_judged_as_its_recording_and_ends_when_it_rests(
    encoder: TouchEncoder, tmp_path: Path
) -> None:
    """Once a second, here of four ticks, of which some come in late; of these only touch is embedded."""
    still, frames = np.zeros((24, 15), np.float32), recorded(24).frames
    still[:18, 9] = 0.03  # rad/s
    frames = {FRONT: frames[FRONT], **{k: frames[k] for k in TACTILE}, STATE: still}
    embedder = EpisodeEmbedder(PaintTowers(), encoder)
    recording = embedder.embed_chunks([Episode(frames=frames, task="", meta={})], 4.0, "recording")
    ends = SuccessfulEnds.of([recording.take(slice(0, n)) for n in (10, 12)])
    ends.save(tmp_path / GOAL_FILE)
    units = {"object": 0.01, "held": 0.3, "slip": 1e-3}
    ends = {"image": 1.0, "tactile": 1.0}, {"image": 0.1, "tactile": 0.1}
    normalizer = DistanceNormalizer(*ends, units, {}, embedder.made_with, "recorded", 3)
    goals = assign_goals([parse_goal(f"goal:{tmp_path / GOAL_FILE}")], ("image", "tactile"))
    reward = PreparedReward(embedder, goals, normalizer, None, "", folder=tmp_path)
    with pytest.raises(UserError, match="no judge lies beside"):
        CostMeter(reward, judges=True)
    costs = [end_cost(reward.end_costs(recording.take(slice(0, n)))) for n in (4, 24)]
    assert costs[0] > costs[1] + 0.1
    Judge((costs[1] + 0.01,) * 20, (costs[0],) * 20).save(tmp_path / JUDGE)
    meter, told, done = CostMeter(reward, rate=4.0, judges=True), [], []
    ticks = [{key: values[i] for key, values in frames.items()} for i in range(24)]
    for i in (0, 1, 2, 3, 4, 7, 8, 11, 15, 19, 23):
        for tick in ticks[{7: 5, 11: 9, 15: 12, 19: 16, 23: 20}.get(i, i) : i + 1]:
            meter.add(tick)
        reading = meter.measure()
        assert reading is not None and meter.measure() is None
        if meter.judgement is not (told[-1] if told else None):
            told.append(meter.judgement)
            expected = reward.judge_episode(recording.take(slice(0, i + 1)))
            assert told[-1].verdict == expected.verdict
            assert told[-1].parts == pytest.approx(expected.parts, abs=1e-5)
        done.append(reading.done)
    assert [t.verdict for t in told] == ["failure"] * 2 + ["success"] * 4
    assert done == [False] * 10 + [True]  # it moved until tick 17, and was judged at 15, 19 and 23


def test_a_cell_chooses_the_encoder_of_its_rewards(tmp_path: Path) -> None:
    text = (EXAMPLES / "sim.toml").read_text()
    cell = tmp_path / "cell.toml"
    plain = PooledEncoder(PooledEncoderConfig.for_sensor("gelsight_mini"))
    save(plain, tmp_path / "plain", {})
    words = f'rewards = ["text:a hard ball"]\nencoder = "{tmp_path / "plain"}"'
    cell.write_text(text.replace("[task]", f"[task]\n{words}"))
    with pytest.raises(UserError, match="was not aligned with texts"):
        load_cell_cost(read_cell_file(cell))


def test_a_task_of_ones_own_is_not_simulated_on_a_twin_either(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its recordings, which a judge is fitted to, hold no simulator's truth."""
    cell, asked = read_cell_file(EXAMPLES / "sim.toml"), []
    monkeypatch.setattr(Reward, "of_judge", lambda *_: Reward())
    monkeypatch.setattr(
        Reward, "prepare", lambda _, inputs: asked.append(inputs.fitted_task) or 1 / 0
    )
    for name in ("pick-place", "block on disc"):
        task = replace(cell.task, name=name, judge="runs/judge", instruction="")
        with pytest.raises(ZeroDivisionError):
            load_cell_cost(replace(cell, task=task))
    assert asked == ["simulated pick-place", "block on disc"]


def test_fit_normalizer_wants_successes(run_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(run_folder)
    for _ in range(2):
        EpisodeWriter(Path("unknown")).append(replace(EPISODE, meta={"sensor": "gelsight_mini"}))
    with pytest.raises(SystemExit, match="2 of 2 episodes of unknown have no recorded outcome"):
        main(["fit-normalizer", "unknown", "--out", "y"])
