"""Every command at toy size, and one clear line for every mistake."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from in_process import in_process_workers, run, run_benchmark
from toy_episodes import record

from benchmarks.papers import mixed_demonstrations, reward_use
from benchmarks.papers.reward_quality import benchmark, recording
from touchgoal.control import features as ft
from touchgoal.control.sensors.clip import read_frames
from touchgoal.encoders import pretrained
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone, TouchBackboneConfig
from touchgoal.encoders.backbones.vit import PRESETS
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch import demo
from touchgoal.launch.__main__ import COMMANDS, usage
from touchgoal.policies import checkpoint
from touchgoal.sim_envs.config import PickPlaceConfig

pytestmark = pytest.mark.usefixtures("in_process")


def refused(capsys: pytest.CaptureFixture, *arguments: object) -> str:
    """Run a command that must fail; return its one-line message."""
    with pytest.raises(SystemExit) as stopped:
        run(*arguments)
    message = stopped.value.code
    assert isinstance(message, str) and message.startswith(f"touchgoal {arguments[0]}: ")
    assert "Traceback" not in capsys.readouterr().err
    return message


@pytest.fixture(scope="session")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two picks of a ball, at half the rate."""
    out = tmp_path_factory.mktemp("demos")
    with in_process_workers():
        run(*"collect-demos --episodes 2 --env.objects glass_ball --env.control-hz 10".split(),
            "--out", out)  # fmt: skip
    return out / "episodes"


def test_help_names_every_command(capsys: pytest.CaptureFixture) -> None:
    for name in COMMANDS:
        assert f"  {name} " in usage()
        with pytest.raises(SystemExit) as stopped:
            run(name, "--help")
        assert stopped.value.code == 0
    assert "--env.grasp-force" in capsys.readouterr().out


def test_collected_episodes_are_sound(episodes: Path, capsys: pytest.CaptureFixture) -> None:
    run("repair", episodes)
    assert "is sound" in capsys.readouterr().out
    found = EpisodeSet(episodes)
    assert len(found) == 2 and found.meta(0)["object"] == "glass_ball"
    assert found.meta(0)["sensor"] == "gelsight_mini"
    config = json.loads((episodes.parent / "config.json").read_text())
    assert config["config"]["episodes"] == 2 and config["touchgoal"]


def test_reward_curves_of_episodes(episodes: Path, tmp_path: Path) -> None:
    out, bare = tmp_path / "curves", tmp_path / "plain"
    goals = "--goal", f"episode:{episodes}#1", "--goal", "text:a hard smooth round object"
    run("reward-curves", episodes, *goals, "--index", 0, "--out", out)
    run("reward-curves", episodes, *goals, "--index", 0, "--plain", "--out", bare)
    image = cv2.imread(str(out / "episode_000.png"))
    assert image is not None and image.shape == (1000, 1200, 3)
    facts, plain = (json.loads((f / "metrics.json").read_text())[0] for f in (out, bare))
    parts = "front wrist wrist_map object force centre held slip words wrench value fused"
    assert facts["source"] == "episodes#0" and facts["contact_source"] == "truth"
    report, plain = facts["measured"], plain["measured"]
    assert set(report) == set(parts.split())
    assert set(plain) == {"image", "tactile", "text", "image+tactile", "image+text"}
    rows = (out / "episode_000.csv").read_text().splitlines()
    assert len(rows) == 1 + EpisodeSet(episodes).lengths[0]
    # A part is at 0.5 within 1.5 spreads of successes.
    for touch, near in ((report["object"], 0.5), (plain["tactile"], 0.3)):
        assert touch["end"] < near < 0.9 < touch["start"]


@pytest.mark.slow
def test_demo(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    config = demo.Config(out=tmp_path, words="a hard smooth round object")
    demo.main(replace(config, env=replace(config.env, max_seconds=2.6)))
    for name in ("episode.mp4", "curves.png", "curves.csv", "metrics.json", "config.json"):
        assert (tmp_path / name).stat().st_size > 0
    frames, fps = read_frames(tmp_path / "episode.mp4")
    assert frames.shape[1:] == (264, 720, 3) and fps == 10
    printed = capsys.readouterr().out
    assert "fused" in printed and str(tmp_path / "curves.png") in printed
    # it is cut short
    assert "sees and feels alone, says: " in printed and "says: success" not in printed


def test_bead_maze(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    maze = "--task bead-maze --workers 1 --episodes 1 --out".split()
    run("collect-demos", *maze, tmp_path / "a", "--env.max-seconds", 1)
    found = EpisodeSet(tmp_path / "a" / "episodes")
    assert found.lengths[0] == 21 and found.meta(0)["wire"] == "fourier-2000000"
    assert found.meta(0)["outcome"] == "failure" and found.meta(0)["disturbance"] == 0.004
    run("run-policy", *maze, tmp_path / "b", "--policy", "follower", "--no-video")
    assert "1/1 [0.21, 1.00]" in capsys.readouterr().out


@pytest.mark.slow
def test_learning_the_bead_maze(here: Path, capsys: pytest.CaptureFixture) -> None:
    """The commands from demonstrations to a policy, at toy size."""
    one = ("--workers", 1)
    record = ("collect-demos", "--task", "bead-maze", "--episodes", 1, "--env.cameras",
              "--env.disturbance", 0, *one)  # fmt: skip
    run(*record, "--out", "demos")
    run(*record, "--seed", 1, "--env.n-wires", 1, "--out", "val")
    both = ("--data", "demos/episodes", "--validation", "val/episodes")
    run("train-encoder", "mae", *both, "--frames", 8, "--mae.vit", "tiny", "--mae.epochs", 1,
        "--mae.batch-size", 8, "--out", "mae")  # fmt: skip
    learn = ("train-policy", *both, *one, "--head", "tiny", "--train.epochs", 2, "--trials", 1,
             "--train.snapshot-epochs", 1, "--env.max-seconds", 1)  # fmt: skip
    run(*learn, "--encoder", "mae/encoder", "--out", "policy")
    tried = json.loads(Path("policy/metrics.json").read_text())["snapshots"]
    assert set(tried) == {"epoch-0001", "epoch-0002"}
    capsys.readouterr()
    run("run-policy", "--task", "bead-maze", "--policy", "policy/policy", "--episodes", 1, *one,
        "--env.as-deployed", "--env.deployment.plan-ticks", 2, "--no-video", "--env.max-seconds", 1)  # fmt: skip
    assert "0/1" in capsys.readouterr().out
    run_benchmark("bead-maze", "--policies", "policy/policy", "--wires", 1, "--held-out", 0,
        "--demonstrations", 2, "--plan-ticks", "--env.max-seconds", 3, *one)  # fmt: skip
    printed = capsys.readouterr().out
    assert "(mae), 1 demos, denoised in 1 step, shuffled" in printed and "zero motion" in printed
    run_benchmark("policy-delay", "--policy", "expert", "--episodes", 1, "--delay", 0, "--jitter", 0, "--rates",
        30, "--workers", 1, "--out", "delay")  # fmt: skip
    run_benchmark("robustness", "--policy", "expert", "--tasks", "pick-place",
        "--changes", "light +10%", "2 ticks late", "--episodes", 1, "--workers", 1)  # fmt: skip
    printed = capsys.readouterr().out
    assert "pick-place, light +10%" in printed and "pick-place, 2 ticks late" in printed
    run_benchmark("robustness", "--policy", "expert", "--tasks", "fragile-carry", "--hidden-verdict",
        "--changes", "unchanged", "--episodes", 1, "--workers", 1)  # fmt: skip
    assert "fragile-carry, unchanged: 0 of 1 successes ended within 2 s" in capsys.readouterr().out
    run_benchmark("policy-latency", "--policy", "policy/policy", "--repeats", 3,
        "--large-repeats", 0)  # fmt: skip
    assert "denoising" in capsys.readouterr().out
    run("train-policy", "--preset", "paper", *both, *one, "--head", "tiny", "--sampler.num-inference-steps", 2, "--trials", 0,
        "--encoder", "mae/encoder", "--train.epochs", 1, "--out", "paper")  # fmt: skip
    paper = checkpoint.load(Path("paper/policy")).config
    assert paper.representation == "delta"
    assert Path("paper/policy/touch/encoder.json").is_file()
    run("train-policy", *both, *one, "--head", "tiny", "--trials", 0, "--encoder", "end-to-end",
        "--train.epochs", 1, "--observation-horizon", 3, "--sampler.loss", "squared", "--out", "jointly")  # fmt: skip
    jointly = checkpoint.load(Path("jointly/policy")).config
    assert jointly.end_to_end and not jointly.touch and jointly.observation_horizon == 3
    assert jointly.sensor == "gelsight_mini_markers" and "squared" in str(jointly.head)
    other = refused(capsys, "run-policy", "--task", "bead-maze", "--policy", "policy/policy",
                    "--env.sensor", "gelsight_mini")  # fmt: skip
    assert "trained with the sensor gelsight_mini_markers" in other


@pytest.mark.slow
def test_learning_to_pick_and_place(here: Path, capsys: pytest.CaptureFixture) -> None:
    """The commands from placements to a corrected policy, at toy size."""
    one, blind = ("--workers", 1), ("--env.no-tactile", "--env.cameras", "--out", "demos")
    run("train-pose-estimator", *one, "--scenes", 2, "--placements", 2, "--train.epochs", 1,
        "--out", "est")  # fmt: skip
    record = ("collect-demos", "--feedback", "--episodes", 1, *one)
    run(*record, *blind)
    run(*record, "--seed", 1, *blind[:2], "--out", "val")
    both = ("--data", "demos/episodes", "--validation", "val/episodes")
    same = refused(capsys, "train-policy", *both[:3], "demos/episodes", "--out", "policy")
    assert "are both" in same
    other = refused(capsys, "train-policy", "--task", "bead-maze", *both, "--out", "policy")
    assert "is of pick-place, not of bead-maze" in other and not Path("policy").exists()
    run("train-policy", "--task", "pick-place", *both, *one, "--estimator", "est/estimator", "--head",
        "regression", "--representation", "base_twist", "--train.epochs", 1, "--trials", 1,
        "--env.max-seconds", 0.5, "--out", "policy")  # fmt: skip
    capsys.readouterr()
    run("collect-demos", "--policy", "policy/policy", "--episodes", 1, *one, *blind,
        "--env.max-seconds", 0.5)  # fmt: skip
    assert "the policy succeeded in 0/1" in capsys.readouterr().out
    found = EpisodeSet(Path("demos/episodes"))
    assert [found.meta(i)["outcome"] for i in range(2)] == ["success", "corrected"]


@pytest.mark.slow
def test_from_recordings_with_cameras_to_a_policy_that_sees(
    here: Path, capsys: pytest.CaptureFixture
) -> None:
    record = ("collect-demos", "--episodes", 1, "--env.control-hz", 10, "--env.no-tactile", "--env.camera-size", 64, 64,
              "--workers", 1)  # fmt: skip
    run(*record, "--out", "demos")
    run(*record, "--seed", 1, "--out", "val")
    learn = ("train-policy", "--data", "demos", "--validation", "val", "--workers", 1, "--head", "tiny",
             "--representation", "base_twist", "--train.epochs", 1, "--trials", 0)  # fmt: skip
    assert "its cameras: observation.images.front" in refused(capsys, *learn, "--cameras", "top")
    run(*learn, "--cameras", "front", "wrist", "--out", "policy")
    policy = checkpoint.load_policy("policy")
    env = policy.env_config(PickPlaceConfig(control_hz=10))
    assert env.cameras == ("front", "wrist") and env.camera_size == (64, 64) and not env.tactile
    recorded = EpisodeSet(Path("demos/episodes")).read(0).frames
    seen = {key: values[0] for key, values in recorded.items()}
    moved = policy.act(seen)
    policy.reset()
    blind = policy.act(seen | {ft.FRONT: np.zeros_like(seen[ft.FRONT])})
    assert moved.shape == (8,) and not np.array_equal(moved, blind)


def test_doctor_and_benchmark(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    run("doctor")
    run_benchmark(*"env-speed --repeats 1 --physics-steps 100 --env-steps 1".split(), "--out",
        tmp_path)  # fmt: skip
    printed = capsys.readouterr().out
    assert "MISSING" not in printed and "two tactile + one 128x128 camera" in printed


@pytest.fixture
def few_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    """Benchmarks of the reward with two objects on either side, and a value that hardly learns."""
    monkeypatch.setattr(recording, "HELD_OUT_OBJECTS", ("brick", "toy_brick"))
    monkeypatch.setattr(mixed_demonstrations, "HELD_OUT_OBJECTS", ("brick", "toy_brick"))
    monkeypatch.setattr(recording, "TRAINING_OBJECTS", ("candle", "soda_can"))
    monkeypatch.setattr("touchgoal.rewards.value._STEPS", 5)


@pytest.mark.slow
@pytest.mark.usefixtures("few_objects")
def test_benchmark_reward_quality(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = ("never_touch", "drop", "wrong_object", "overgripped")
    outcomes = ("success", "slow", "regrasped", *kinds)
    monkeypatch.setattr(recording, "OUTCOMES", outcomes)  # test_envs.py has the others
    monkeypatch.setattr(benchmark, "KINDS", kinds)
    monkeypatch.setattr(benchmark, "TRUE_KINDS", kinds[:-1])
    sizes = "--episodes 1 --suboptimal 1 --successes 2 --training 4 --goals 1 --calibration 4"
    words = f"reward-quality {sizes} --scenes fixed --every 2 --env.control-hz 5"
    run_benchmark(*words.split(), "--env.camera-size", 64, 64, "--out", tmp_path)
    result = json.loads((tmp_path / "metrics.json").read_text())["scenes"]["fixed"]
    assert set(result["auc"]) == {*kinds, "mean of true kinds"}
    assert result["episodes"] == dict.fromkeys(outcomes, 1) | {"success": 2}
    assert len(result["claims"]) >= 4


@pytest.mark.slow
@pytest.mark.usefixtures("few_objects")
def test_benchmark_reward_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reward_use, "_TASK", PickPlaceConfig(objects=("brick",), max_seconds=1))
    begin = mixed_demonstrations._FIRST_SEED + 7  # a right one, one beside, one above
    monkeypatch.setattr(mixed_demonstrations, "_FIRST_SEED", begin)
    sizes = "--training 4 --goals 1 --demonstrations 3 --validation 1 --seeds 1 --trials 1"
    words = f"reward-use {sizes} --train.epochs 1 --every 8"
    weights = ("--weights", "none", "accepted by judge")
    run_benchmark(*words.split(), *weights, "--env.camera-size", 64, 64, "--out", tmp_path)
    rows = json.loads((tmp_path / "metrics.json").read_text())["imitation"]
    assert rows["none"][0]["used"] == 1 and 0.2 < rows["accepted by judge"][0]["used"] < 0.5


def test_an_encoder_is_trained_and_validated_on_fit_data(
    episodes: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    record(tmp_path / "other", range(2))
    data = ("--data", episodes, "--out", tmp_path / "out", "--validation")
    assert "validate on episodes" in refused(capsys, "train-encoder", "mae", *data, episodes)
    dotted = (tmp_path / "other", "--sensor", "gelsight_mini_markers")
    message = refused(capsys, "train-encoder", "align", *data, *dotted)
    assert "was recorded with gelsight_mini, not" in message and not (tmp_path / "out").exists()


def test_encoder_speed(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    pair = replace(PRESETS["tiny"], channels=6)
    backbone = TouchBackbone(TouchBackboneConfig.for_sensor(pair, "gelsight_mini", 2))
    pretrained.save(backbone, tmp_path / "pair", {})
    run_benchmark("encoder-speed", "--encoders", tmp_path / "pair", "gelsight_mini", "--shapes",
        "mae-tiny", "--batch-size", 2, "--repeats", 1, "--ticks", 1, "--out", tmp_path / "run")  # fmt: skip
    printed = capsys.readouterr().out
    assert "Sparsh mae-tiny, random" in printed
    rows = json.loads((tmp_path / "run" / "metrics.json").read_text())["rows"]
    assert [row["precision"] for row in rows] == ["fp32", "bf16", "fp32", "fp32", "bf16"]
