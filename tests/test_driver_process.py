"""Drivers in a child process: whatever the library or the parent does, it ends and says why."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from numbered_images import until

from touchgoal.control.arms.driver_process import DriverProcess
from touchgoal.control.arms.franka import FrankaClient
from touchgoal.control.arms.streaming import ArmClient, ArmConfig
from touchgoal.control.arms.ur import UrClient
from touchgoal.control.interfaces import DriverError
from touchgoal.control.safety.limits import FR3
from touchgoal.runtime.errors import UserError

# A child imports its driver by name, so it stands in a module.
ODD_DRIVER = """
import ctypes, os, time
from touchgoal.runtime.errors import UserError

class Odd:
    period = 0.01

    def __init__(self, log, mood=""):
        self.log, self.mood = open(log, "a", buffering=1), mood
        self.log.write(f"pid {os.getpid()}\\n")
        if mood == "hangs at once":
            ctypes.PyDLL(None).sleep(60)  # as a C library that keeps Python's lock

    def tick(self):
        if self.mood == "crashes":
            print("a library's last words", flush=True)
            ctypes.string_at(0)
        if self.mood == "gives up":
            raise OSError("no such\\n cable")

    def add(self, a, b):
        return a + b

    def fail(self):
        raise KeyError("of some library")

    def refuse(self):
        raise UserError("do it by hand")

    def hang(self):
        ctypes.PyDLL(None).sleep(60)

    def close(self):
        self.log.write("at rest\\n")
"""

PARENT = """
import sys
from odd_driver import Odd
from touchgoal.control.arms.driver_process import DriverProcess
seconds = 1.0 if sys.argv[2:] == ["short"] else 60.0
child = DriverProcess(Odd, sys.argv[1], call_timeout=seconds)
print("ready", flush=True)
if sys.argv[2:]:
    child.call("hang")
sys.stdin.read()
"""


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "odd_driver.py").write_text(ODD_DRIVER)
    path = os.pathsep.join(p for p in (str(tmp_path), os.environ.get("PYTHONPATH")) if p)
    monkeypatch.setenv("PYTHONPATH", path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "odd_driver", raising=False)
    return tmp_path / "log"


def odd(log: Path, mood: str = "", **timeouts: float) -> DriverProcess:
    from odd_driver import Odd  # pyright: ignore[reportMissingImports]

    return DriverProcess(Odd, str(log), mood, **{"connect_timeout": 60.0, **timeouts})


def pid(log: Path) -> int:
    return int(log.read_text().split()[1])


def running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_calls_are_answered_and_errors_arrive_as_errors(log: Path) -> None:
    child = odd(log)
    assert child.call("add", 2, 3) == 5
    with pytest.raises(DriverError, match="KeyError: 'of some library'"):
        child.call("fail")
    with pytest.raises(UserError, match="by hand"):
        child.call("refuse")
    assert child.call("add", 1, 1) == 2
    child.close()
    assert not running(pid(log)) and log.read_text().endswith("at rest\n")
    with pytest.raises(DriverError, match="closed"):
        child.call("add", 1, 1)


def test_a_library_that_hangs_is_ended(log: Path) -> None:
    with pytest.raises(DriverError, match="did not connect within 3 s"):
        odd(log, "hangs at once", connect_timeout=3.0)
    assert not running(pid(log))
    log.unlink()
    child = odd(log, call_timeout=0.3)
    for _ in range(2):
        with pytest.raises(DriverError, match="did not hang within 0.3 s"):
            child.call("hang")
    assert not running(pid(log)) and not child.alive
    child.close()


@pytest.mark.parametrize(
    ("mood", "words"),
    [("crashes", "SIGSEGV.*last words"), ("gives up", "^OSError: no such cable$")],
)
def test_a_crash_is_told_with_its_last_words(log: Path, mood: str, words: str) -> None:
    child = odd(log, mood)
    until(lambda: not child.alive)
    with pytest.raises(DriverError, match=words):
        child.call("add", 1, 1)
    child.close()


def parent(log: Path, *words: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", PARENT, str(log), *words]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout and process.stdout.readline() == b"ready\n"
    return process


@pytest.mark.parametrize("signal_", [signal.SIGKILL, signal.SIGINT], ids=["killed", "Ctrl-C"])
def test_a_parent_that_goes_leaves_the_device_at_rest(log: Path, signal_: signal.Signals) -> None:
    process = parent(log)
    process.send_signal(signal_)
    process.wait(20)
    until(lambda: not running(pid(log)))
    assert log.read_text().endswith("at rest\n")


def test_a_killed_parent_with_a_hung_library_leaves_nothing_running(log: Path) -> None:
    process = parent(log, "short")
    time.sleep(0.3)
    process.send_signal(signal.SIGKILL)
    process.wait(20)
    until(lambda: not running(pid(log)))


@pytest.mark.parametrize(
    ("client", "module"), [(FrankaClient, "franky"), (UrClient, "rtde_receive")]
)
def test_a_missing_client_library_is_said_in_a_line(
    client: type[ArmClient], module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UserError, match=f"{module} is missing: pip install"):
        client(ArmConfig("127.0.0.1", FR3, 100.0, 0.5), False)
