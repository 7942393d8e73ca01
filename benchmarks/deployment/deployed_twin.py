"""A `touchgoal twin` process to deploy on."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from touchgoal.benchmarks.deployment.deployed_episode import Scene
from touchgoal.runtime.errors import UserError

_START_TIMEOUT, _END_TIMEOUT = 300.0, 60.0  # s, on a loaded machine


@contextmanager
def deployed_twin(
    scene: Scene, lock_step: bool, folder: Path, number: int, exact: bool = False
) -> Iterator[Path]:
    """Run a twin with a scene and yield the cell file that it wrote.

    Twins of different numbers run side by side. An exact one reports true forces, without an arm's
    estimation error.

    Raises:
        UserError: The twin does not start.
    """
    kind = "--env.wires" if scene.task == "bead-maze" else "--env.objects"
    command = [sys.executable, "-m", "touchgoal.launch", "twin", "--task", scene.task]
    command += [kind, scene.item, "--seed", str(scene.seed), "--port", "0", "--out", str(folder)]
    command += ["--host", own_address(100 + number % 100)]
    command += [*["--lock-step"] * lock_step, *["--no-wrench-error"] * exact]
    cell_file, end = folder / "cell.json", time.monotonic() + _START_TIMEOUT
    with (folder / "twin.log").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            while not cell_file.exists():
                if process.poll() is not None or time.monotonic() > end:
                    raise UserError(f"no twin: {(folder / 'twin.log').read_text()[-500:]}")
                time.sleep(0.05)
            yield cell_file
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(_END_TIMEOUT)
            except subprocess.TimeoutExpired:
                process.kill()


def own_address(number: int) -> str:
    """Return a loopback address that only this process uses, one a number."""
    pid = os.getpid()
    return f"127.{number}.{pid // 250 % 250}.{1 + pid % 250}"
