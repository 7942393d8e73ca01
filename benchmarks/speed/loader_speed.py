"""Training samples a second on one core: lerobot's loader and train-policy's, on one set in one run.

A sample is two ticks of both fingertips and of the arm, with the actions of eight. lerobot decodes the images of every
sample anew and returns images: the time to embed them is not counted. train-policy embeds each image once with its
frozen encoder, keeps the embeddings beside the set and samples from memory; the embedding counts in its first epoch.
"""

import subprocess
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from benchmarks.deployment.own_task import touchgoal
from benchmarks.options import BenchmarkOptions
from benchmarks.speed.rates import one_core
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies.network import PolicyConfig
from touchgoal.policies.perception.frozen_touch import load_touch
from touchgoal.policies.training.sequence_dataset import SequenceDataset, load_recordings
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.json_file import parse_json
from touchgoal.runtime.option_types import Count, checked_dataclass

_BATCH = 64
_PEER = Path(__file__).with_name("lerobot_loader.py")


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark loader-speed."""

    lerobot: Path = Path(".venv-lerobot/bin/python")
    """Python of an environment with lerobot, as `make interop-lerobot` makes one."""
    demonstrations: Count = 6
    """Demonstrations of the bead maze in the set."""
    epochs: Count = 60
    """Epochs of a training, over which the embedding is spread."""
    samples: Count = 640
    """Samples that lerobot draws, in random order and in order."""


def run(config: Config) -> dict[str, Any]:
    """Record a set and load it by both."""
    if not config.lerobot.is_file():
        raise UserError(f"no {config.lerobot}: make interop-lerobot, or --lerobot PYTHON")
    with TemporaryDirectory() as name, one_core():
        what = "--task", "bead-maze", "--episodes", config.demonstrations, "--workers", 1
        touchgoal("collect-demos", *what, "--out", name)
        root = Path(name) / "episodes"
        peers = _lerobot(config, root, Path(name) / "lerobot.json")
        first, later, count = _ours(root)
    epochs = config.epochs
    ours = count * epochs / (first + (epochs - 1) * later)
    rates = {
        f"lerobot {peers['version']}, shuffled": peers["shuffled"],
        f"lerobot {peers['version']}, in order": peers["in_order"],
        "train-policy, first epoch, embedding included": count / first,
        "train-policy, each further epoch": count / later,
        f"train-policy, {epochs} epochs": ours,
    }
    lines = [f"{'':<48}{'samples a second':>18}{'of lerobot shuffled':>21}"]
    lines += [f"{k:<48}{v:>18,.0f}{v / peers['shuffled']:>20.1f}x" for k, v in rates.items()]
    return {"table": "\n".join(lines), "rates": rates, "samples": count}


def _lerobot(config: Config, root: Path, out: Path) -> dict[str, Any]:
    command = [config.lerobot, _PEER, root, out, str(_BATCH), str(config.samples)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise UserError(f"lerobot: {' '.join(done.stderr.split())[-300:]}")
    return parse_json(out.read_bytes())


def _ours(root: Path) -> tuple[float, float, int]:
    """Return the seconds of the first and of a further epoch, and its samples."""
    start, episodes, touch = (
        time.perf_counter(),
        EpisodeSet(root),
        load_touch("gelsight_mini_markers_mae"),
    )
    policy = PolicyConfig(touch.dim, touch.name, control_hz=episodes.fps)
    recordings = load_recordings(episodes, range(len(episodes)), policy, touch)
    windows = SequenceDataset(recordings, policy)
    _epoch(windows)
    first, start = time.perf_counter() - start, time.perf_counter()
    for _ in range(10):
        _epoch(windows)
    return first, (time.perf_counter() - start) / 10, len(windows)


def _epoch(windows: SequenceDataset) -> None:
    for rows in torch.randperm(len(windows)).split(_BATCH):
        windows.take(rows)
