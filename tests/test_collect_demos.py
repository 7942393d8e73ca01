"""Recording demonstrations: processes, failures, interruptions."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch.__main__ import main

QUICK = "--env.objects glass_ball --env.no-tactile --env.cameras --env.max-seconds 0.2".split()


def processes_with(mark: str) -> list[str]:
    """Command lines of the processes that have `mark` in their environment."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (process / "environ").read_bytes():
                found.append((process / "cmdline").read_bytes().replace(b"\0", b" ").decode())
        except OSError:
            continue
    return found


def test_a_killed_recording_leaves_no_process_and_can_be_continued(tmp_path: Path) -> None:
    mark = f"TOUCHGOAL_TEST_MARK={tmp_path}"
    command = ["collect-demos", "--episodes", "2", "--workers", "2", *QUICK, "--out", str(tmp_path)]
    line = [sys.executable, "-m", "touchgoal.launch", *command]
    environment = os.environ | dict([mark.split("=")])
    with subprocess.Popen(line, env=environment, stderr=subprocess.DEVNULL) as recorder:
        while len(processes_with(mark)) < 5:  # itself, fork server, tracker, two workers
            time.sleep(0.05)
            assert recorder.poll() is None
        recorder.send_signal(signal.SIGKILL)
    for _ in range(100):
        if not processes_with(mark):
            break
        time.sleep(0.1)
    assert processes_with(mark) == []
    shutil.rmtree(tmp_path / "episodes", ignore_errors=True)
    (tmp_path / "episodes").mkdir()  # as killed before its first episode
    main(["repair", str(tmp_path)])
    main(["repair", str(tmp_path), "--fix"])
    main(command)
    assert len(EpisodeSet(tmp_path)) == 2


def test_ten_failures_from_the_start_stop_a_recording(
    in_process: None, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("touchgoal.launch.collect_demos._MAX_FAILURES", 2)
    with pytest.raises(SystemExit) as stopped:
        main(["collect-demos", "--workers", "1", *QUICK, "--out", str(tmp_path)])
    assert stopped.value.code == 3
    assert "0 of 2 succeeded, most often failed: time is up" in capsys.readouterr().err
    assert len(EpisodeSet(tmp_path)) == 2
