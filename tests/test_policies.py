"""Judging policies, shipped and one's own; what is recorded for them and what they learn from."""

import json
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from toy_episodes import record

from touchgoal.control import features as ft
from touchgoal.control.sensors.clip import read_frames
from touchgoal.encoders.training.weights import WeightsFormat
from touchgoal.episodes.outcomes.judged import JudgedOutcome, write_judged
from touchgoal.episodes.recording import EpisodeSpec
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.launch.__main__ import main, read_options
from touchgoal.launch.run_policy import Config as RunPolicy
from touchgoal.launch.run_policy import _changed_options
from touchgoal.policies import checkpoint
from touchgoal.policies.acting import LearnedPolicy
from touchgoal.policies.by_name import choose_policy, prepare_policy
from touchgoal.policies.checkpoint import EPISODE_OBJECT, load_policy
from touchgoal.policies.evaluation import evaluate as evaluation
from touchgoal.policies.evaluation.evaluate import evaluate, run_trials, trial_specs
from touchgoal.policies.evaluation.report import film_trials, table
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.policies.heads.diffusion import DiffusionConfig
from touchgoal.policies.sight.frozen_images import ImageEmbedder, ImageInputConfig
from touchgoal.policies.training.embedding_cache import embed_episodes
from touchgoal.policies.training.training_data import (
    choose_episodes,
    choose_judged,
    common_fact,
    find_task,
)
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.deployment import DeploymentConfig
from touchgoal.sim_envs.config import BeadMazeConfig, PickPlaceConfig
from touchgoal.sim_envs.experts.pick_place import PickPlaceExpert
from touchgoal.sim_envs.tasks import make_env


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [(8, 10, 0.49, 0.94), (16, 20, 0.58, 0.92), (10, 10, 0.72, 1.0), (0, 10, 0.0, 0.28)],
)
def test_wilson_interval(successes: int, trials: int, low: float, high: float) -> None:
    """Published values (Wilson 1927; the same from R's prop.test without correction)."""
    assert SuccessRate(successes, trials).interval == pytest.approx((low, high), abs=0.005)


def test_trials_depend_on_their_seed_alone() -> None:
    config = PickPlaceConfig(cameras=(), tactile=False)
    jobs = [EpisodeSpec(seed, options={"object": "toy_brick"}) for seed in (1, 2)]
    apart = [run_trials(config, PickPlaceExpert, [job], workers=1) for job in jobs]
    assert list(run_trials(config, PickPlaceExpert, jobs, workers=2)) == [t for (t,) in apart]


def test_what_ships_picks_and_places() -> None:
    policy = load_policy("pick-place")
    config = policy.env_config(PickPlaceConfig(objects=("glass_ball",)))
    assert config.cameras == ("front",) and config.tactile and config.camera_size == (256, 256)
    result = evaluate(policy, config, episodes=1, seed=2_000_000)
    assert str(result) == "1/1 [0.21, 1.00]" and result.trials[0].episode["object"] == "glass_ball"
    env = make_env(policy.env_config())
    observation, _ = env.reset(seed=0)
    plans = []
    for _ in range(2):
        policy.reset()
        plans.append([policy.act(observation) for _ in range(3)])
    np.testing.assert_array_equal(*plans)
    assert env.action_space.shape == plans[0][0].shape
    env.close()


class Still:
    """A policy of one's own that does nothing."""

    episodes = 0

    def reset(self) -> None:
        Still.episodes += 1

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        assert ft.FRONT not in observation
        return np.zeros(8)

    def env_config(self, config: PickPlaceConfig) -> PickPlaceConfig:
        return replace(config, cameras=(), tactile=False)


def test_a_policy_of_ones_own_is_judged(tmp_path: Path) -> None:
    config = PickPlaceConfig(objects=("glass_ball", "bottle_cap"), max_seconds=0.2)
    for policy in (Still, Still(), f"{__file__}:Still"):
        result = evaluate(policy, config, episodes=2)
        assert result.rate.successes == 0 and [t.failure for t in result.trials] == ["time"] * 2
        assert [t.episode["object"] for t in result.trials] == ["glass_ball", "bottle_cap"]
    assert Still.episodes == 4  # the file was imported anew, as in a worker
    for name, message in {
        f"{__file__}:Stil": "test_policies.py 'Stil': did you mean Still",
        f"{__file__}:Path": "has no method reset",
        "pick-plac": "did you mean pick-place",
        "bead-maze": "was trained for bead-maze, not for pick-place",
        "follower": "add: --task bead-maze",
        str(tmp_path): "train one with",
    }.items():
        with pytest.raises(UserError, match=message):
            prepare_policy(name, config)


OWN = """
class Own:
    def reset(self): pass
    def act(self, observation): return self.helper(observation)
    def helper(self, observation): return observation["observation.image"]
"""


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("", "own.py:5 in Own.helper: KeyError: 'observation.image' (the observation has: obser"),
        (
            "    def __init__(self): self.gain",
            "own.py:6 in Own.__init__: AttributeError: 'Own' obj",
        ),
        (
            "    def reset(self): 1 / 0",
            "own.py:6 in Own.reset: ZeroDivisionError: division by zero",
        ),
        (
            "    def env_config(self, config): pass",
            "own.py:Own: env_config gave None; return its op",
        ),
        (
            "    def env_config(self, config): config.camera",
            "own.py:6 in Own.env_config: Attribute",
        ),
        (
            "    def env_config(self, config): type(config)(mas=1)",
            "Own.env_config: PickPlaceConfig:",
        ),
        ("import nonesuch", "own.py:6: ModuleNotFoundError: No module named 'nonesuch'"),
        ("def (", "own.py: SyntaxError: invalid syntax (own.py, line 6)"),
    ],
)
def test_a_mistake_in_ones_own_policy_is_one_line(more: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(OWN + more)
    for _ in range(2):  # a file that failed is not taken for a loaded one
        with pytest.raises(UserError) as mistake:
            make, _ = choose_policy(f"{tmp_path / 'own.py'}:Own", PickPlaceConfig())
            policy = make(SimpleNamespace(n_joints=7))
            policy.act({ft.STATE: np.zeros(15)})
        assert message in str(mistake.value) and "\n" not in str(mistake.value)
        assert message.startswith("own.py:Own:") or mistake.value.__cause__ is not None


class Stopped:
    """A frozen encoder that Ctrl-C stops once at its third episode."""

    name, shape = "toy", (1,)

    def __init__(self) -> None:
        self.embedded: list[int] = []

    def embed(self, episodes: EpisodeSet, i: int) -> np.ndarray:
        self.embedded.append(i)
        if self.embedded == [0, 1, 2]:
            raise KeyboardInterrupt
        return np.full((episodes.lengths[i], 1), i)


def test_a_stop_while_embedding_costs_one_episode(tmp_path: Path) -> None:
    record(tmp_path, range(4))
    encoder, episodes = Stopped(), EpisodeSet(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        embed_episodes(episodes, range(4), encoder)
    rows = embed_episodes(EpisodeSet(tmp_path), range(4), encoder)
    assert encoder.embedded == [0, 1, 2, 2, 3]
    assert [row[0, 0] for row in rows] == [0, 1, 2, 3]


def test_what_comes_next_has_the_options_of_the_task() -> None:
    late = DeploymentConfig(image_delay=(0.0, 0.05))
    env = PickPlaceConfig(objects=("wooden_block",), as_deployed=True, deployment=late)
    _, twin = read_options("twin", shlex.split(_changed_options(env, RunPolicy.env)))
    assert replace(twin.env, camera_size=env.camera_size) == env
    assert not _changed_options(RunPolicy.env, RunPolicy.env)


@pytest.mark.parametrize(
    ("policy", "options", "message"),
    [
        ("shipped", {"tactile": False}, r"--env\.no-tactile: .* runs with --env\.tactile; leave"),
        ("expert", {"camera_size": (64, 64)}, "the policy expert reads no camera"),
        ("shipped", {"arm": "ur5e"}, "seven joints of an FR3"),
    ],
)
def test_an_option_that_a_policy_fixes_is_kept(policy: str, options: dict, message: str) -> None:
    with pytest.raises(UserError, match=message):
        prepare_policy(policy, PickPlaceConfig(**options))
    maze = BeadMazeConfig(cameras=("front",))  # which a judge may read
    assert prepare_policy("shipped", maze)[1].cameras == ("front",)


def test_a_target_is_told_to_what_takes_one(capsys: pytest.CaptureFixture[str]) -> None:
    blind = PickPlaceConfig(cameras=(), tactile=False)
    env = make_env(replace(blind, objects=("golf_ball",), distractors=1))
    env.reset(seed=0)
    for target, told in (
        (f"the {EPISODE_OBJECT}", "the golf ball"),
        ("a red block", "a red block"),
    ):
        maker, _ = prepare_policy("shipped", PickPlaceConfig(distractors=1), target)
        assert cast(LearnedPolicy, maker(env)).target == told and not capsys.readouterr().err
    policy = load_policy("pick-place", target="a red block")
    again = prepare_policy(policy, PickPlaceConfig(distractors=1))[0](env)
    assert cast(LearnedPolicy, again).target == "a red block"
    prepare_policy("shipped", PickPlaceConfig(distractors=2))
    assert "nothing says which of 3 objects is meant: add --target" in capsys.readouterr().err
    for name, task, target, message in (
        ("shipped", PickPlaceConfig(), " ", "the target is empty: name the object"),
        ("shipped", PickPlaceConfig(), "not the red block", "hardly notices 'not'"),
        ("shipped", BeadMazeConfig(), "a bead", "takes no target"),
        ("expert", PickPlaceConfig(), "a red block", "the policy expert takes no target"),
    ):
        with pytest.raises(UserError, match=message):
            prepare_policy(name, task, target)


class Degrees(Still):
    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return np.full(8, 57.0)


def test_a_policy_in_degrees_is_said() -> None:
    """Wrong shapes and NaN: test_deploy.py."""
    (trial,) = evaluate(Degrees, PickPlaceConfig(max_seconds=0.2), episodes=1).trials
    assert trial.clamped == 1 and "100% of the actions are beyond" in table([trial])


def test_evaluation_leaves_torch_alone_and_reads_weights_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    read, load_weights = [], WeightsFormat.load_weights
    monkeypatch.setattr(
        WeightsFormat, "load_weights", lambda f, *a: read.append(f.stem) or load_weights(f, *a)
    )
    checkpoint._load_network.cache_clear()
    checkpoint._load_parts.cache_clear()
    threads, state = torch.get_num_threads(), torch.get_rng_state()
    torch.set_num_threads(threads + 1)
    try:
        evaluate("bead-maze", BeadMazeConfig(max_seconds=0.2), episodes=2)
        assert torch.get_num_threads() == threads + 1
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(torch.get_rng_state(), state)
    assert sorted(read) == ["encoder", "policy"]


BLIND_ENV = PickPlaceConfig(cameras=(), tactile=False, max_seconds=0.5)
BLIND = ("--env.objects", "glass_ball", "--env.no-tactile", "--env.cameras", "--workers", "1")


def test_ctrl_c_keeps_the_trials_that_ended(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_trial, done = evaluation.run_trial, []

    def stopped(*arguments):
        if done:
            raise KeyboardInterrupt
        done.append(run_trial(*arguments))
        return done[0]

    monkeypatch.setattr(evaluation, "run_trial", stopped)
    with pytest.raises(SystemExit) as end:
        main(["run-policy", "--policy", "expert", "--out", str(tmp_path), *BLIND])
    assert end.value.code == 130
    assert "stopped after 1 of 20 episodes: 1/1 [0.21, 1.00]" in capsys.readouterr().out
    (line,) = (tmp_path / "trials.jsonl").read_text().splitlines()
    assert json.loads(line)["seed"] == 1_000_000
    assert json.loads((tmp_path / "metrics.json").read_text())["trials"] == 1


def test_ctrl_c_keeps_what_is_recorded_and_says_how_to_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    append = EpisodeWriter.append

    def stopped(writer: EpisodeWriter, episode):
        if len(writer) == 1:
            raise KeyboardInterrupt
        return append(writer, episode)

    command = ["collect-demos", "--episodes", "2", *BLIND, "--out", str(tmp_path)]
    with monkeypatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setattr(EpisodeWriter, "append", stopped)
        patch.setattr("sys.argv", ["touchgoal", *command])
        main(command)
    assert end.value.code == 130
    assert f"finished episodes are in {tmp_path / 'episodes'}" in capsys.readouterr().err
    for printed in ("1 episodes recorded, 2 in", "nothing left to record: 2 episodes"):
        main(command)
        assert printed in capsys.readouterr().out
    episodes = EpisodeSet(tmp_path / "episodes")
    assert [episodes.meta(i)["seed"] for i in range(len(episodes))] == [0, 1]
    assert episodes.meta(0)["task"] == "pick-place"


def test_only_what_is_known_to_be_good_is_learned_from(tmp_path: Path) -> None:
    facts = [{"outcome": "success", "success": True}, {"outcome": "failure", "success": False},
             {"outcome": "corrected", "success": False}, {"outcome": "unknown", "success": False}]  # fmt: skip
    writer = EpisodeWriter(tmp_path / "set")
    frames = {ft.STATE: np.zeros((3, 15), np.float32)}
    for fact in facts:
        writer.append(Episode(frames, "feel", fact | {"task": "bead-maze"}))
    episodes = EpisodeSet(tmp_path / "set")
    chosen = choose_episodes(episodes)
    assert chosen.rows == [0, 2]
    assert str(chosen) == "2 episodes (1 that failed, 1 of unknown success left out)"
    assert choose_episodes(episodes, include_unknown=True).rows == [0, 2, 3]
    with pytest.raises(UserError, match="4 of 4 .* not judged: judge it first: touchgoal judge"):
        choose_judged(episodes)
    verdicts = ("failure", "success", "unsure", "success")
    write_judged(episodes, {i: JudgedOutcome(v) for i, v in enumerate(verdicts)})
    chosen = choose_judged(episodes)
    assert chosen.rows == [1, 3], "whatever was recorded"
    assert str(chosen) == "2 episodes (1 that failed, 1 judged unsure left out)"
    writer = EpisodeWriter(tmp_path / "arm")
    writer.append(Episode(frames, "feel", {"outcome": "stopped", "sensor": "digit"}))
    arm = EpisodeSet(tmp_path / "arm")
    with pytest.raises(UserError, match="1 of unknown success.*add --include-unknown"):
        choose_episodes(arm)
    assert find_task([(episodes, [0, 1]), (episodes, [2])], None) == "bead-maze"
    with pytest.raises(UserError, match="more than one task"):
        find_task([(episodes, [0]), (arm, [0])], None)
    assert common_fact("sensor", [(arm, [0])]) == "digit"


class SecondTickJudge:
    """Says success lastingly at the second tick."""

    def __init__(self, env: object) -> None:
        self.ticks = 0

    def ended(self, tick: dict) -> bool:
        self.ticks += 1
        return self.ticks == 2

    def verdict(self) -> str:
        return "success"


def test_a_judge_ends_an_episode_beside_the_simulator() -> None:
    specs = trial_specs(BLIND_ENV, 1, 5)
    trials = list(run_trials(BLIND_ENV, PickPlaceExpert, specs, 1, SecondTickJudge))
    assert (trials[0].judged, trials[0].success) == ("success", False)
    assert trials[0].seconds == pytest.approx(1 / BLIND_ENV.control_hz)
    assert "the judge says of the 1 failures: 1 success" in table(trials)


def test_the_films_show_the_trials(tmp_path: Path) -> None:
    config, specs = BLIND_ENV, trial_specs(BLIND_ENV, 2, 5)
    trials = list(run_trials(config, PickPlaceExpert, specs, workers=1))
    film_trials(tmp_path, config, specs, trials, PickPlaceExpert, workers=1)
    frames, fps = read_frames(tmp_path / "worst.mp4")
    assert fps == 10 and len(frames) == 6
    assert sorted(p.name for p in tmp_path.iterdir()) == ["best.mp4", "worst.mp4"]


def test_a_tick_embeds_like_its_episode_and_another_size_is_refused() -> None:
    images = np.random.default_rng(0).integers(0, 256, (5, 64, 96, 3), np.uint8)
    embedder = ImageEmbedder(ImageInputConfig((ft.FRONT, ft.WRIST), (64, 96)))
    together = embedder._maps(images)
    alone = embedder.embed_tick({ft.FRONT: images[4], ft.WRIST: images[0]})
    assert alone.shape == embedder.shape == (2, 40, 28, 42)
    np.testing.assert_allclose(alone, together[[4, 0]], atol=2e-2)
    with pytest.raises(UserError, match="camera images are 64 x 64, the policy reads 64 x 96"):
        embedder.embed_tick({ft.FRONT: images[0, :, :64], ft.WRIST: images[0]})


def test_a_learned_policy_acts_and_deploys_without_a_simulator(tmp_path: Path) -> None:
    program = Path(__file__).parent / "without_a_simulator.py"
    subprocess.run([sys.executable, program, tmp_path], check=True, timeout=300)


def test_the_shipped_maze_policy_knows_no_truth_of_the_simulator() -> None:
    config = load_policy("bead-maze").config
    assert isinstance(config.head, DiffusionConfig)
    assert config.touch_dim and not config.estimated
