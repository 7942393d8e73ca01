"""Deploying, on the twin over the wire, on a simulated arm, and with faults; `touchgoal arm`.

The block that is picked up and placed over the wire: test_documented_commands.py.
"""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import blocked_packages
import numpy as np
import pytest
from fake_cell import SIM, FakeCell, write_cell_file
from in_process import run
from rerun_rows import rerun_rows, rerun_views
from running_twin import RunningTwin

from touchgoal.control import features as ft
from touchgoal.control.arms.client_libraries import FRANKY
from touchgoal.control.cell.cell_file import find_cell_file, read_cell_file
from touchgoal.control.deployment.control_loop import JUDGED, Request, TickStatus
from touchgoal.control.deployment.session import Session, metrics, report
from touchgoal.control.interfaces import Actor, CostReading, DriverError
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.limits import FR3
from touchgoal.episodes.episode_recorder import EpisodeRecorder
from touchgoal.episodes.format.repair import repair, validate
from touchgoal.episodes.schema import MetaValue
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.launch.__main__ import main
from touchgoal.launch.deploy import NOT_DONE, STOPPED
from touchgoal.launch.support.cell_run import confirm, connect
from touchgoal.launch.twin import open_to_network
from touchgoal.runtime.errors import UserError

_PATIENCE = 600  # s for a loop, on a machine however loaded


def deploying(twin: RunningTwin, out: Path) -> "subprocess.Popen[str]":
    """Start `touchgoal deploy --execute` in a process, without simulator and checks of types."""
    command = [sys.executable, blocked_packages.__file__, "deploy", str(twin.cell_file)]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([*command, "--execute", "--yes", "--out", str(out / "run")], **pipes)


@pytest.mark.slow
def test_the_shipped_policy_leads_a_bead_on_the_twin(tmp_path: Path) -> None:
    pytest.importorskip("franky", reason=FRANKY.install)
    cell = ["--lock-step", "--task", "bead-maze", "--env.wires", "helix-3", "--env.cameras"]
    with closing(RunningTwin(cell, tmp_path, 3)) as twin:
        _, complaint = deploying(twin, tmp_path).communicate(timeout=_PATIENCE)
        worst = twin.ask("truth")["worst"]
    assert complaint == "" and worst["excess"] == 0 and worst["speed"] < 1
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["success"]


@pytest.mark.slow
def test_a_stalled_camera_stops_the_arm_and_the_episode_is_kept(tmp_path: Path) -> None:
    pytest.importorskip("franky", reason=FRANKY.install)
    cell = ["--lock-step", "--env.objects", "wooden_block", "--seed", "3", "--env.cameras", "front"]
    with closing(RunningTwin(cell, tmp_path, 2)) as twin:
        process = deploying(twin, tmp_path)
        while np.abs(twin.ask("truth")["dq"]).max() < 0.1:
            assert process.poll() is None, process.communicate()[1]
            time.sleep(0.02)
        twin.ask("stall front 600")
        while twin.ask("truth")["rest"] < 1 and process.poll() is None:  # longer than it is held
            time.sleep(0.02)
        twin.ask("stall front 0")  # a program that ends waits for the image on its way
        _, complaint = process.communicate(timeout=_PATIENCE)
    assert process.returncode == STOPPED and "observation age" in complaint and "front" in complaint
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["stopped"] and metrics["rest_seconds"] < 3 and "cable" in metrics["advice"]
    episodes = tmp_path / "run" / "episodes"
    meta = EpisodeSet(episodes).meta(0)
    assert meta["outcome"] == "stopped" and meta["success"] is False and validate(episodes) == []


def test_a_simulated_arm_does_the_job(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    file = write_cell_file(tmp_path, SIM)
    shown = ["--rerun", tmp_path / "a.rrd"] if find_spec("rerun") else []
    run("deploy", file, "--execute", "--yes", "--out", tmp_path / "run", *shown)
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    episodes = EpisodeSet(tmp_path / "run" / "episodes")
    meta = episodes.meta(0)
    if shown:
        rows = rerun_rows(tmp_path / "a.rrd")
        assert rows["/front"] == rows["/force (N)/force"] == episodes.lengths[0]
        plots = {"force (N)", "gripper width (mm)", "joint change (rad)"}
        assert rerun_views(tmp_path / "a.rrd") == {"front"} | plots
    assert metrics["success"] and meta["arm"] == "sim" and meta["success"] is True
    printed = capsys.readouterr().out
    assert "the hand still holds something" in printed and "task: done" in printed


def test_a_disk_that_fills_up_costs_one_episode_and_is_said_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table is there, earlier episodes are whole."""
    cell = write_cell_file(tmp_path, SIM.replace("seed = 3", "seed = 3, seconds = 0.4"))
    arguments = ["deploy", cell, "--execute", "--yes", "--out", tmp_path / "run"]
    with pytest.raises(SystemExit) as ended:
        run(*arguments)  # kept
    assert ended.value.code == NOT_DONE  # time is up

    def full(source: Path, target: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))

    append = EpisodeWriter.append

    def append_on_a_full_disk(*arguments) -> int:
        monkeypatch.setattr(os, "replace", full)
        return append(*arguments)

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as ended:
        patch.setattr(EpisodeWriter, "append", append_on_a_full_disk)
        run(*arguments)
    printed = capsys.readouterr()
    assert "ticks of the control loop" in printed.out and "ended: time is up" in printed.out
    assert "could not be saved" in f"{ended.value.code}{printed.err}"
    assert len(EpisodeSet(tmp_path / "run" / "episodes")) == 1


def test_a_dry_run_moves_and_records_nothing(tmp_path: Path) -> None:
    text = SIM.replace("seed = 3", "seed = 3, seconds = 1.0")
    run("deploy", write_cell_file(tmp_path, text), "--out", tmp_path / "run")
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["ticks"] > 10 and metrics["episode"] is None and not metrics["success"]


class Still(Actor):
    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return np.array([*np.zeros(7), 0.04])


@pytest.mark.parametrize(
    ("policy", "request_", "success", "outcome"),
    [
        ("expert", "done", True, "success"),
        ("expert", "not done", False, "failure"),
        ("expert", "", False, "failure"),
        ("own", "", True, "success"),  # it says that it is done: the operator is asked
        ("own", "", None, "unknown"),
    ],
)
def test_without_a_simulator_the_operator_says_whether_it_is_done(
    policy: str, request_: Request, success: bool | None, outcome: str, tmp_path: Path
) -> None:
    """A plan that ends by itself with an empty hand is a failure."""
    cell, connection = read_cell_file(write_cell_file(tmp_path, SIM)), FakeCell().connection()
    cell = replace(cell, task=replace(cell.task, policy=policy))
    safety = ActionFilter(connection.robot, ft.CONTROL_HZ)
    actor, ticks = Still(), []

    def on_tick(status: TickStatus) -> None:
        ticks.append(status)
        actor.done = len(ticks) > 5

    def wanted() -> Request:
        return request_ if len(ticks) > 2 else ""

    recorder = EpisodeRecorder(tmp_path / "episodes", ft.CONTROL_HZ)
    made = recorder, True, lambda _: actor, wanted, on_tick
    session = Session(cell, connection, safety, *made, ask=lambda _: success)
    assert session.run().success is success
    meta = EpisodeSet(tmp_path / "episodes").meta(0)
    assert meta["outcome"] == outcome and meta.get("success") is success


class FakeJudge:
    """Says one verdict; after `ends_at` ticks that the run is to end."""

    def __init__(self, verdict: Any, ends_at: int = 999) -> None:
        self.reading, self.ends_at, self.ticks = (
            CostReading(0.3, 0.0, verdict, ("why",)),
            ends_at,
            0,
        )

    def begin(self, observation: dict) -> None: ...

    def hand_over(self, observation: dict) -> None:
        self.ticks += 1

    def read(self) -> CostReading:
        return replace(self.reading, done=self.ticks >= self.ends_at)

    def judge(self) -> CostReading:
        return self.reading


@pytest.mark.parametrize(
    ("judge", "answer", "success", "outcome", "reason"),
    [
        (FakeJudge("success", 5), None, True, "judged success", JUDGED),
        (FakeJudge("success"), None, True, "judged success", "time is up (1 s)"),
        (FakeJudge("failure"), True, False, "judged failure", "time is up (1 s)"),
        (FakeJudge("unsure"), None, None, "unknown", "time is up (1 s)"),
        (FakeJudge("unsure"), True, True, "success", "time is up (1 s)"),
    ],
)
def test_a_judge_ends_a_run_and_says_how_it_ended(
    judge: FakeJudge, answer: bool | None, success: bool | None, outcome: str, reason: str, tmp_path: Path
) -> None:  # fmt: skip
    """Of a simulator's verdict nothing is read; a person is asked where the judge is unsure."""
    text = SIM.replace("seed = 3", 'seed = 3, seconds = 1.0, judge = "runs/judge"')
    cell = read_cell_file(write_cell_file(tmp_path, text.replace('"expert"', '"shipped"')))
    connection = replace(FakeCell().connection(), truth=lambda: {}["success"])
    safety = ActionFilter(connection.robot, ft.CONTROL_HZ)
    recorder = EpisodeRecorder(tmp_path / "episodes", ft.CONTROL_HZ)
    result = Session(
        cell, connection, safety, recorder, True, lambda _: Still(), lambda: "", lambda _: None, judge,
        ask=lambda question: answer,
    ).run()  # fmt: skip
    meta = EpisodeSet(tmp_path / "episodes").meta(0)
    assert (result.success, result.ending.reason) == (success, reason)
    assert (meta["outcome"], meta["judged"]) == (outcome, judge.reading.verdict)
    assert meta.get("success") == (answer if outcome == "success" else None)  # a person's alone
    ticks = 5 if reason == JUDGED else 20 + 20 + 2  # it held still for a second
    assert result.log.ticks == pytest.approx(ticks, abs=2)
    assert f"the judge says: {judge.reading.verdict}" in report(result, metrics(result), "")


def test_a_judged_run_goes_beside_demonstrations(tmp_path: Path) -> None:
    """It has a cost, and another's word on its outcome; the demonstrations stay what they were."""
    told: list[dict[str, MetaValue]] = [
        {"success": True},
        {"judged": "failure"},
        {"success": False},
    ]
    checksums = set()
    for meta in told:
        recorder = EpisodeRecorder(tmp_path / "set", ft.CONTROL_HZ)
        for _ in range(2):
            cost = {ft.COST: np.ones(1, np.float32)} if "judged" in meta else {}
            recorder.add({ft.STATE: np.zeros(15, np.float32), **cost})
        recorder.save("put it down", meta)
        checksums.add(EpisodeSet(tmp_path / "set").episode_checksum(0))
    (tmp_path / "set" / "meta" / "stats.json").unlink()
    repair(tmp_path / "set")
    episodes = EpisodeSet(tmp_path / "set")
    assert [episodes.meta(i) for i in range(3)] == told
    assert ft.COST not in episodes.features and validate(tmp_path / "set") == []
    assert checksums == {episodes.episode_checksum(0)}


OWN = """
import numpy as np

class Turns:
    def reset(self): self.ticks = 0
    def act(self, observation):
        self.ticks += 1
        return np.array([0.004, *np.zeros(6), 0.08])
"""


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ("np.zeros(7)", "act gave an array of shape (7,); return 7 joint changes (rad)"),
        ("np.full(8, np.nan)", "return finite numbers"),
        ("1 / 0", "own.py:8 in Turns.act: ZeroDivisionError: division by zero"),
        (
            "observation['observation.state'].sort()",
            "own.py:8 in Turns.act: ValueError: sort array is read-only",
        ),
    ],
)
def test_a_wrong_policy_of_ones_own_stops_the_arm_with_its_name(
    answer: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    own = OWN.replace("np.array([0.004, *np.zeros(6), 0.08])", answer)
    (tmp_path / "own.py").write_text(own)
    with pytest.raises(SystemExit) as ended:
        run("deploy", write_cell_file(tmp_path, SIM), "--policy", f"{tmp_path / 'own.py'}:Turns",
            "--execute", "--yes", "--out", tmp_path / "run")  # fmt: skip
    printed = capsys.readouterr().err
    assert ended.value.code == STOPPED and message in printed and "own.py" in printed


def test_an_interrupted_pipe_keeps_the_report_and_the_status(tmp_path: Path) -> None:
    """`deploy | tee log` and Ctrl-C, which also ends tee; standard input is closed."""
    cell = write_cell_file(tmp_path, SIM)
    command = f"exec {sys.executable} -m touchgoal.launch deploy {cell} --execute --yes <&-"
    process = subprocess.Popen(
        [*"sh -c".split(), f"{command} --out {tmp_path / 'run'}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout and process.stderr
    while "MOVING" not in (line := process.stdout.readline()):
        assert line, process.stderr.read()
    process.stdout.close()
    process.send_signal(signal.SIGINT)
    printed = process.stderr.read()
    assert process.wait(_PATIENCE) == STOPPED
    assert "STOPPED: stopped by the operator" in printed and "at rest after" in printed


def test_a_policy_that_lacks_its_fingertips_is_refused_before_anything_else(tmp_path: Path) -> None:
    path = write_cell_file(tmp_path, SIM)
    with pytest.raises(SystemExit, match="the policy feels with fingertips"):
        run("deploy", path, "--policy", "shipped", "--out", tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_a_twin_beyond_loopback_says_that_the_network_can_drive_it() -> None:
    for host in ("127.0.0.1", "127.3.0.9", "localhost", "::1"):
        assert not open_to_network(host)
    for host in ("0.0.0.0", "192.168.1.7", "robot-pc"):
        assert "any computer there can drive this arm" in open_to_network(host)


START = FR3.arm.home + 0.1 * np.eye(7)[0]  # rad: elsewhere than where the twin begins


@pytest.mark.slow
def test_arm_commands_on_the_twin(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    pytest.importorskip("franky", reason=FRANKY.install)
    cell = ["--lock-step", "--env.objects", "wooden_block", "--env.no-tactile", "--env.cameras"]
    with closing(RunningTwin(cell, tmp_path, 5)) as twin:
        table = json.loads(twin.cell_file.read_text())
        table["task"]["start"] = START.tolist()
        cell_file = tmp_path / "own.json"
        cell_file.write_text(json.dumps(table))

        def arm(action: str) -> dict:
            main(["arm", action, str(cell_file), "--yes"])
            return twin.at_rest()

        np.testing.assert_allclose(arm("home")["q"], START, atol=2e-3)
        closed = arm("close")
        assert closed["width"] < 0.002 and np.allclose(closed["q"], START, atol=2e-3)
        assert arm("open")["width"] > 0.07
        twin.ask("error cartesian_reflex")
        with pytest.raises(SystemExit) as stopped:
            arm("home")
        assert stopped.value.code == 4 and "reflex" in capsys.readouterr().err
        arm("recover")
        assert "recovered: the arm takes commands" in capsys.readouterr().out
        np.testing.assert_allclose(arm("home")["q"], START, atol=2e-3)
        assert twin.ask("truth")["worst"]["excess"] == 0
        twin.ask("stop-button on")
        with pytest.raises(SystemExit, match="not recovered: user stop: release"):
            arm("recover")
        twin.ask("stop-button off")


def test_a_simulated_arm_and_an_empty_chair_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="a simulated arm ends with its command"):
        main(["arm", "home", "sim"])
    with pytest.raises(SystemExit, match="nobody is there to confirm"):
        main(["arm", "open", "ur5e"])


def test_nobody_confirms_what_moves_nothing_real(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", None)
    sim = read_cell_file(find_cell_file(Path("sim")))
    confirm(sim)
    real = read_cell_file(find_cell_file(Path("fr3_two_minis")))
    confirm(replace(real, task=replace(real.task, twin=f"token@{real.address}:8081")))
    for twin in ("", "token@127.0.0.1:8081"):  # a real arm, whatever else serves a twin
        with pytest.raises(UserError, match="nobody is there to confirm"):
            confirm(replace(real, task=replace(real.task, twin=twin)))


def test_every_device_that_does_not_open_is_a_row(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    no_arm = MagicMock(side_effect=DriverError("no controller answers"))
    monkeypatch.setattr("touchgoal.control.cell.connection.connect_arm", no_arm)
    real = read_cell_file(find_cell_file(Path("fr3_two_minis")))
    gone = replace(real, address="127.9.9.9", load_cell=None)
    gone = replace(gone, gripper=replace(gone.gripper, address="127.9.9.9"))
    with pytest.raises(UserError) as error:
        connect(gone)
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("MISSING")]
    names = [row.split()[1] for row in rows]
    assert names == ["front", "tactile_left", "tactile_right", "gripper", "arm"]
    assert all(f"{name}: " in str(error.value) for name in names) and "\n" not in str(error.value)
