"""Franka's own client against the twin, and our driver against controllers that are not ours.

    python tests/interop/run.py [NAME ...]      NAME: pylibfranka, franka-sim, franky-sim; none: all

franky and ur-rtde drive the twin in test_twin_clients.py.

What is not ours runs in the virtual environment `.venv-interop` (`make interop` makes it), each in a process
of its own. It prints what each one found, and fails if that is wrong.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
from emulators import COMMANDS, drive  # noqa: E402
from running_twin import RunningTwin  # noqa: E402

PYTHON = HERE.parents[1] / ".venv-interop" / "bin" / "python"
_TIMEOUT = 400.0  # s
_TOLERANCE = 5e-3  # rad or m


def near(value: Any, expected: Any, tolerance: float = _TOLERANCE) -> bool:
    """Whether all numbers are."""
    return bool(np.allclose(value, expected, atol=tolerance))


def check_pylibfranka(result: dict[str, Any]) -> dict[str, bool]:
    """Commanded: 0.1 rad, -0.1 rad (an integral of sin squared), 0.05 rad, and 0.1 rad again."""
    return {
        "gravity is felt": result["gravity"] > 5,
        "positions": near(result["position"], 0.1),
        "velocities": near(result["velocity"], -0.1),
        "torques": near(result["torque"], 0.05, 0.03),
        "a jump is refused": "discontinuity" in result["error"] or "violation" in result["error"],
        "recovery": near(result["recovered"], 0.1),
    }


def run_pylibfranka(number: int) -> bool:
    """The client on a twin; whether all is as it should be."""
    cell = ["--env.objects", "wooden_block", "--seed", "3", "--env.cameras", "--env.no-tactile"]
    with tempfile.TemporaryDirectory() as folder:
        twin = RunningTwin(["--arm", "fr3", "--lock-step", *cell], Path(folder), number)
        try:
            done = subprocess.run(
                [str(PYTHON), str(HERE / "pylibfranka_client.py"), twin.cell.address],
                capture_output=True,
                text=True,
                timeout=_TIMEOUT,
            )
        finally:
            twin.close()
    if done.returncode != 0:
        print(f"pylibfranka: it failed: {done.stderr.strip().splitlines()[-1:]}", flush=True)
        return False
    result = json.loads(done.stdout.splitlines()[-1])
    return report("pylibfranka", check_pylibfranka(result), str(result))


def report(name: str, found: dict[str, bool], result: str) -> bool:
    """Print what was found; whether all is as it should be."""
    print(
        f"{name}: " + ", ".join(f"{what} {'ok' if ok else 'WRONG'}" for what, ok in found.items())
    )
    if not all(found.values()):
        print(f"  {result}", flush=True)
    return all(found.values())


def run_emulator(name: str, number: int) -> bool:
    """Our driver on one of them; whether all is as it should be."""
    found, figures = drive(name, str(PYTHON), str(HERE), number)
    print(f"{name}: {figures}")
    return report(name, found, figures)


if __name__ == "__main__":
    everything = ["pylibfranka", *COMMANDS]
    results = []
    for name in sys.argv[1:] or everything:
        number = 20 + everything.index(name)
        own = run_pylibfranka(number) if name == "pylibfranka" else run_emulator(name, number)
        results.append(own)
    sys.exit(0 if all(results) else 1)
