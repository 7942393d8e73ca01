"""Every command and snippet of README and docs: understood as printed, run at toy size."""

import json
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from documented_commands import (
    NOT_RUN,
    NOTEBOOK,
    PAGES,
    ROOT,
    Command,
    commands,
    exit_status,
    read_options,
    recipes,
    snippets,
)
from PIL import Image
from test_own_object import write_box

from touchgoal.control.cell.cell_file import read_cell_file
from touchgoal.control.cell.twin_client import ask_twin
from touchgoal.control.tactile import sensor_models
from touchgoal.episodes.media import write_video
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch import __main__ as launch
from touchgoal.launch.demo import FILMED
from touchgoal.launch.deploy import NOT_DONE
from touchgoal.policies.checkpoint import POLICY_FORMAT, SHIPPED_POLICIES
from touchgoal.rewards.distance.parts import FUSED, SMALLEST_UNIT, VALUE, WORDS
from touchgoal.rewards.report.plot import CURVES
from touchgoal.runtime.parallel.parallel_map import one_core_workers

Shell = Callable[[list[str]], int]
ALL = list(commands())


@pytest.mark.parametrize("command", ALL, ids=lambda c: f"{c.page}: {c.line}")
def test_command_is_understood(command: Command, capsys: pytest.CaptureFixture, here: Path) -> None:
    write_box(here / "mug.obj", (0.08, 0.05, 0.06))  # which docs/own_object.md names
    words = command.words
    if words[0] == "make":
        targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert set(words[1:]) <= set(targets)
        return
    if words[0] == "launch/deploy.sh":
        words = ["touchgoal", "deploy", *words[1:]]
    assert not command.whole or "…" not in command.line and "..." not in command.line
    try:
        read_options(words[1:] if words[0] == "touchgoal" else words)
    except SystemExit as end:
        if not end.code:  # it printed something and is done, as --help
            return
        complaint = capsys.readouterr().err
        assert not command.whole and "required" in complaint.lower(), complaint


POLICIES = "maze-policy pick-place-policy fragile-carry-policy".split()
TARGETS = "demo images weights weights-markers weights-markers-mae fragile-carry".split() + POLICIES
ASIDE = ("data", "validation", "out", "resume", "workers", "trials", "env")  # learn nothing


@pytest.mark.parametrize("target", TARGETS)
def test_recipes_of_the_makefile_are_understood(target: str, here: Path) -> None:
    assert recipes(target)
    for words in recipes(target):
        read_options(words)


@pytest.mark.parametrize("policy", ["pick-place", "fragile-carry", "bead-maze"])
def test_shipped_policies_learnt_by_their_recipe(policy: str, here: Path) -> None:
    made = POLICY_FORMAT.provenance(SHIPPED_POLICIES[policy])["command"]
    target = f"{policy.removeprefix('bead-')}-policy"
    last = [words for words in recipes(target) if words[0] == "train-policy"][-1]
    options = [vars(launch.read_options(w[0], w[1:])[1]) for w in (shlex.split(made)[1:], last)]
    learnt = [{k: v for k, v in one.items() if k not in ASIDE} for one in options]
    assert learnt[0] == learnt[1]


@pytest.mark.parametrize(
    ("name", "curves"),
    [("demo", {*FILMED}), ("reward_page", {*SMALLEST_UNIT, VALUE, WORDS, FUSED})],
)
def test_images_show_the_curves_of_today(name: str, curves: set[str]) -> None:
    """By their names and colours; else: make images."""
    with Image.open(ROOT / "docs" / f"{name}.png") as image:
        assert json.loads(image.info["curves"]) == {curve: CURVES[curve] for curve in curves}


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with what the pages take for granted: a video, an image, files of one's own."""
    folder = tmp_path_factory.mktemp("desk")
    frames = np.random.default_rng(0).integers(0, 256, (12, 96, 128, 3), dtype=np.uint8)
    write_video(folder / "my_video.mp4", frames, 20)
    cv2.imwrite(str(folder / "goal.png"), frames[-1])
    sensor = Path(sensor_models.__file__).parent / "sensor_files" / "gelsight_mini"
    shutil.copytree(sensor, folder / "runs" / "mini" / "sensor_file")
    shutil.copy(ROOT / "control" / "cell" / "examples" / "sim.toml", folder / "my_cell.toml")
    for page in PAGES:
        for code in snippets(page):
            if named := re.match(r"# (\w+\.py)\n", code):
                (folder / named[1]).write_text(code)
    before = Path.cwd()
    os.chdir(folder)
    yield folder
    os.chdir(before)


TYPED = [
    c
    for c in ALL
    if c.whole and c.words[0] not in ("make", "benchmarks") and c.words[1] not in NOT_RUN
]
DEPLOYING = [
    c for c in TYPED if c.words[0] == "launch/deploy.sh" or c.words[1] in ("twin", "deploy")
]
THE_JOB = "touchgoal deploy runs/twin/cell.json --execute"  # what the package is for
CUT = 1.0  # s, of a run whose end is not the subject


@pytest.fixture(scope="module")
def shell(desk: Path) -> Iterator[Shell]:
    """Another process, in which commands run one after the other; it returns how one ends.

    What they import is imported once; in here their types would be checked meanwhile, which takes longer.
    """
    with one_core_workers(1) as pool:
        yield lambda words: pool.submit(exit_status, words).result()


@pytest.mark.slow
def test_commands_run(shell: Shell) -> None:
    """All commands in the order of the pages."""
    for command in TYPED:
        if command not in DEPLOYING:
            assert shell(command.small) == 0, command


@pytest.mark.slow
def test_deploying_without_a_twin_runs(desk: Path, shell: Shell) -> None:
    for command in DEPLOYING:
        words = command.small
        if command.words[0] == "launch/deploy.sh":
            program = [str(ROOT / command.words[0]), *words]
            with _cut(desk / words[0]) if "--execute" not in words else nullcontext():
                path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
                done = subprocess.run(program, env={**os.environ, "PATH": path})
            assert done.returncode == 0, command
        elif words[0] == "deploy" and not words[1].startswith("runs/twin"):
            assert shell(words) == 0, command


@pytest.mark.slow
def test_deploying_on_the_twin_runs(desk: Path, shell: Shell) -> None:
    """The first twin that a page starts stays, for all that is deployed on it."""
    cell_file = desk / "runs" / "twin" / "cell.json"
    twin = _serve(next(c.small for c in DEPLOYING if c.words[1] == "twin"), cell_file)
    try:
        _the_job_is_done(desk, cell_file, shell)
        for command in DEPLOYING:
            words = command.small
            if words[:2] != ["deploy", "runs/twin/cell.json"] or command.line == THE_JOB:
                continue
            learned = "--policy" in words
            with _cut(cell_file) if learned or "--execute" not in words else nullcontext():
                ended = shell(words)
            # A learned policy may fail; it says so.
            assert ended in ((0, NOT_DONE) if learned else (0,)), command
    finally:
        twin.terminate()
        twin.wait(30)


def _the_job_is_done(desk: Path, cell_file: Path, shell: Shell) -> None:
    """The expert's block is held and placed within all limits, as the twin knows, and felt."""
    [job] = [command for command in DEPLOYING if command.line == THE_JOB]
    run = desk / "runs" / "job"
    assert shell([*job.small, "--out", str(run)]) == 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["success"] and not metrics["stopped"] and metrics["episode"] == 0
    assert 0.03 < metrics["held_width"] < 0.07
    worst = ask_twin(read_cell_file(cell_file).task.twin, "truth")["worst"]
    assert worst["excess"] == 0 and worst["speed"] < 1
    assert shell(["reward-curves", str(run / "episodes"), "--out", str(run / "curves")]) == 0
    [report] = json.loads((run / "curves" / "metrics.json").read_text())
    assert report["measured"]["tactile"]["end"] < report["measured"]["tactile"]["start"]


@contextmanager
def _cut(cell_file: Path) -> Iterator[None]:
    """Meanwhile what the cell file starts ends after CUT."""
    text = cell_file.read_text()
    shorter, found = re.subn(r'\b(seconds"?\s*[=:]\s*)[\d.]+', rf"\g<1>{CUT}", text)
    assert found == 1
    cell_file.write_text(shorter)
    yield
    cell_file.write_text(text)


def _serve(words: list[str], cell_file: Path) -> "subprocess.Popen[bytes]":
    host = f"127.9.{os.getpid() // 250 % 250}.{1 + os.getpid() % 250}"  # beside other tests' twins
    command = [sys.executable, "-m", "touchgoal.launch", *words, "--host", host]
    twin = subprocess.Popen(command)
    deadline = time.monotonic() + 120
    while not cell_file.exists():
        assert twin.poll() is None and time.monotonic() < deadline
        time.sleep(0.1)
    return twin


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [p for p in [NOTEBOOK, *PAGES] if snippets(p)], ids=lambda page: page.name
)
def test_snippets_run(
    page: Path, desk: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(desk))
    monkeypatch.setattr(sensor_models, "SENSORS", dict(sensor_models.SENSORS))  # a page adds one
    if not (desk / "data").exists():  # README's line recorded it if it ran on this worker
        recording = next(
            c for c in TYPED if c.line.startswith("touchgoal collect-demos --episodes 4")
        )
        assert exit_status(recording.small) == 0
    made: dict[str, Any] = {}
    for i, code in enumerate(snippets(page)):
        program = desk / f"snippet_{i}.py"
        program.write_text(code.replace("n_steps=512", "n_steps=16").replace("100_000", "16"))
        made = runpy.run_path(str(program))
    if page == NOTEBOOK:
        assert made["done"] and set(made["curves"].costs) == {"image", "tactile", "text"}
    if page.stem == "README":
        assert len(made["curves"]) == 8  # one trajectory
    if page.stem == "rewards":
        assert len(made["cost"]) == EpisodeSet(desk / "data" / "episodes").lengths[0]
        assert (desk / "curves.png").exists()
    if page.stem == "own_sensor":  # nothing is touched in the first tick
        assert not made["touched"] and made["depth"].shape == (240, 320) and made["force"] < 1
    if page.stem == "own_task":
        episodes = EpisodeSet(desk / "my_episodes")
        assert [episodes.meta(i)["success"] for i in range(len(episodes))] == [True, True]
    if page.stem == "own_policy":  # picks nothing up and crushes nothing, over 3 s
        assert "0/2 [0.00, 0.66]\nTrue\n" in capsys.readouterr().out
