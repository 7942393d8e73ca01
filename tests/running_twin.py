"""A twin in a process of its own, and clients in processes of theirs.

franky waits for ever for a slot that is taken, and ur-rtde crashes when it reconnects by itself, so
every client has a time-out.
"""

import inspect
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from threading import Timer
from typing import Any

from touchgoal.control.cell import twin_client
from touchgoal.control.cell.cell_file import read_cell_file


class RunningTwin:
    """A twin at the n-th address of this process.

    Attributes:
        cell: what its cell.json says.
        cell_file: that file.
    """

    def __init__(self, arguments: list[str], out: Path, n: int) -> None:
        host = f"127.{10 + n}.{os.getpid() // 250 % 250}.{1 + os.getpid() % 250}"
        command = [sys.executable, "-m", "touchgoal.launch", "twin", "--port", "0"]
        self._process = subprocess.Popen(
            [*command, "--host", host, "--out", str(out), *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        deadline = time.monotonic() + 120
        self.cell_file = out / "cell.json"
        while not self.cell_file.exists():
            if self._process.poll() is not None or time.monotonic() > deadline:
                self._process.kill()
                raise AssertionError(f"no twin: {self._process.communicate()[1]}")
            time.sleep(0.05)
        self.cell = read_cell_file(self.cell_file)

    def ask(self, line: str) -> dict[str, Any]:
        """Send the twin a command and return its answer."""
        return twin_client.ask_twin(self.cell.task.twin, line)

    def at_rest(self) -> dict[str, Any]:
        """Wait until the arm rests; return the simulator's truth."""
        deadline = time.monotonic() + 60
        while (truth := self.ask("truth"))["rest"] < 0.1:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        return truth

    def begin(self, line: str) -> None:
        """Reset the cell once the arm is at rest."""
        self.at_rest()
        self.ask(line)

    def pause_images(self, seconds: float) -> None:
        """Let the process that draws its images stand still for a while."""
        pid = self._process.pid
        (drawing,) = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        os.kill(int(drawing), signal.SIGSTOP)
        Timer(seconds, os.kill, (int(drawing), signal.SIGCONT)).start()

    def close(self) -> None:
        """End the twin by Ctrl-C."""
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(20)
        finally:
            self._process.kill()
        assert self._process.returncode == 0, self._process.communicate()[1]


def client(function: Callable, *arguments: object, using: Callable | None = None) -> dict[str, Any]:
    """Run a function in a process of its own, with the source of one that it is `using`."""
    source = "\n".join(inspect.getsource(part) for part in (using, function) if part)
    program = (
        f"import json, sys, time\nimport numpy as np\n{source}\n"
        f"print(json.dumps({function.__name__}(*json.loads(sys.argv[1]))), flush=True)\n"
        "import os; os._exit(0)"  # ur-rtde's threads may outlive the interpreter
    )
    done = subprocess.run(
        [sys.executable, "-c", program, json.dumps(arguments)],
        capture_output=True,
        text=True,
        timeout=150,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])
