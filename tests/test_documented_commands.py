"""Every command and snippet of README and docs: understood as printed, run at toy size."""

import os
import re
import runpy
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from documented_commands import (
    NOT_RUN,
    PAGES,
    ROOT,
    Command,
    commands,
    exit_status,
    recipes,
    snippets,
)

from touchgoal.control.tactile import sensor_models
from touchgoal.episodes.media import write_video
from touchgoal.episodes.recording import one_core_workers
from touchgoal.launch.__main__ import COMMANDS, read_options
from touchgoal.launch.commands.deploy import NOT_DONE

Shell = Callable[[list[str]], int]
ALL = list(commands())
# own_*.md: test_own_pages.py
SNIPPET_PAGES = [p for p in PAGES if snippets(p) and not p.stem.startswith("own_")]
SHELL = [sys.executable, "-m", "touchgoal.launch"]


def by_line(command: Command) -> str:
    return f"{command.page}: {command.line}"


@pytest.mark.parametrize("command", ALL, ids=by_line)
def test_command_is_understood(
    command: Command, capsys: pytest.CaptureFixture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = command.words
    if words[0] == "make":
        targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert set(words[1:]) <= set(targets)
        return
    name, *options = words[1:] if words[0] == "touchgoal" else ["deploy", *words[1:]]
    assert name in COMMANDS
    assert not command.whole or "…" not in command.line and "..." not in command.line
    try:
        read_options(name, options)
    except SystemExit:
        told = capsys.readouterr().err
        assert not command.whole and "required" in told.lower(), told


@pytest.mark.parametrize(
    "target", ["demo", "weights", "weights-markers", "maze-policy", "pick-place-policy"]
)
def test_recipes_of_the_makefile_are_understood(
    target: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert recipes(target)
    for name, *options in recipes(target):
        read_options(name, options)


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with what the pages take for granted: a video, a picture, files of one's own."""
    folder = tmp_path_factory.mktemp("desk")
    frames = np.random.default_rng(0).integers(0, 256, (12, 96, 128, 3), dtype=np.uint8)
    write_video(folder / "my_video.mp4", frames, 20)
    cv2.imwrite(str(folder / "goal.png"), frames[-1])
    sensor = Path(sensor_models.__file__).parent / "sensor_files" / "gelsight_mini"
    shutil.copytree(sensor, folder / "runs" / "mini" / "sensor_file")
    shutil.copy(ROOT / "launch" / "cells" / "sim.toml", folder / "my_cell.toml")
    for page in PAGES:
        for code in snippets(page):
            if named := re.match(r"# (\w+\.py)\n", code):
                (folder / named[1]).write_text(code)
    before = Path.cwd()
    os.chdir(folder)
    yield folder
    os.chdir(before)


TYPED = [c for c in ALL if c.whole and c.words[0] != "make" and c.words[1] not in NOT_RUN]
DEPLOYING = [
    c for c in TYPED if c.words[0] == "launch/deploy.sh" or c.words[1] in ("twin", "deploy")
]


@pytest.fixture(scope="module")
def shell(desk: Path) -> Iterator[Shell]:
    """Another process, in which commands run one after the other; it returns how one ends.

    What they import is imported once; in here their types would be checked meanwhile, which takes longer.
    """
    with one_core_workers(1) as pool:
        yield lambda words: pool.submit(exit_status, words).result()


@pytest.mark.slow
def test_commands_run(shell: Shell) -> None:
    """One after the other, as a person would who reads the pages from the first to the last."""
    for command in TYPED:
        if command not in DEPLOYING:
            assert shell(command.small) == 0, command


@pytest.mark.slow
def test_deploying_runs(desk: Path) -> None:
    """The first twin that a page starts stays, for all that is deployed on it."""
    twin = None
    try:
        for command in DEPLOYING:
            words = command.small
            if words[0] == "twin":
                twin = twin or _serve(words, desk / "runs" / "twin" / "cell.json")
                continue
            if command.words[0] == "launch/deploy.sh":
                program = [str(ROOT / command.words[0]), *words, "--yes"]
            else:
                program = [*SHELL, *words]
            done = subprocess.run(program, env={**os.environ, "PATH": _path()})
            # A learned policy may fail; it says so.
            assert done.returncode in ((0, NOT_DONE) if "--policy" in words else (0,)), command
    finally:
        if twin is not None:
            twin.terminate()
            twin.wait(30)


def _path() -> str:
    return f"{Path(sys.executable).parent}:{os.environ['PATH']}"


def _serve(words: list[str], cell_file: Path) -> "subprocess.Popen[bytes]":
    host = f"127.9.{os.getpid() // 250 % 250}.{1 + os.getpid() % 250}"  # beside other tests' twins
    twin = subprocess.Popen([*SHELL, *words, "--host", host])
    deadline = time.monotonic() + 120
    while not cell_file.exists():
        assert twin.poll() is None and time.monotonic() < deadline
        time.sleep(0.1)
    return twin


@pytest.mark.slow
@pytest.mark.parametrize("page", SNIPPET_PAGES, ids=lambda page: page.name)
def test_snippets_run(page: Path, desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(desk))
    for i, code in enumerate(snippets(page)):
        program = desk / f"snippet_{i}.py"
        program.write_text(code)
        runpy.run_path(str(program))
