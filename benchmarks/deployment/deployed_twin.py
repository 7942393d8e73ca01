"""A `touchgoal twin` process to deploy on."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.config import TaskName

_START_TIMEOUT, _END_TIMEOUT = 300.0, 60.0  # s, on a loaded machine


class DeployedTwin:
    """A running `touchgoal twin`.

    Attributes:
        cell_file: cell file that it wrote.
    """

    def __init__(
        self,
        task: TaskName,
        seed: int,
        item: str,
        lock_step: bool,
        folder: Path,
        number: int,
        exact: bool = False,
    ) -> None:
        """Start a twin with an object or a wire; twins of different numbers run side by side.

        An exact twin reports true forces, without an arm's estimation error.
        """
        pid = os.getpid()
        host = f"127.{100 + number % 100}.{pid // 250 % 250}.{1 + pid % 250}"
        kind = "--env.wires" if task == "bead-maze" else "--env.objects"
        command = [sys.executable, "-m", "touchgoal.launch", "twin", "--task", task, kind, item]
        command += ["--seed", str(seed), "--host", host, "--port", "0", "--out", str(folder)]
        self._log = (folder / "twin.log").open("w")
        self._process = subprocess.Popen(
            [*command, *["--lock-step"] * lock_step, *["--no-wrench-error"] * exact],
            stdout=self._log,
            stderr=self._log,
        )
        self.cell_file = folder / "cell.json"
        end = time.monotonic() + _START_TIMEOUT
        while not self.cell_file.exists():
            if self._process.poll() is not None or time.monotonic() > end:
                self._process.kill()
                raise UserError(f"no twin: {(folder / 'twin.log').read_text()[-500:]}")
            time.sleep(0.05)

    def __enter__(self) -> "DeployedTwin":
        """Return itself; it runs already."""
        return self

    def __exit__(self, *_: object) -> None:
        """Interrupt the twin, and kill it if it does not end."""
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(_END_TIMEOUT)
        except subprocess.TimeoutExpired:
            self._process.kill()
        self._log.close()
