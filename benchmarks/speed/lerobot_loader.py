"""Samples a second of lerobot's own loader, for loader_speed.py; runs in lerobot's environment.

python lerobot_loader.py SET OUT BATCH SAMPLES
"""

import json
import sys
import time
from importlib.metadata import version
from pathlib import Path

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # pyright: ignore[reportMissingImports]

PLANNED = 8  # actions of a sample


def rate(dataset: LeRobotDataset, batch: int, samples: int, shuffle: bool) -> float:
    """Samples a second, after a first batch that opens the files."""
    batches = iter(torch.utils.data.DataLoader(dataset, batch, shuffle=shuffle))
    next(batches)
    start, drawn = time.perf_counter(), 0
    while drawn < samples:
        drawn += len(next(batches)["action"])
    return drawn / (time.perf_counter() - start)


def main() -> None:
    """Measure, and write the rates."""
    root, out, batch, samples = sys.argv[1], Path(sys.argv[2]), *map(int, sys.argv[3:])
    torch.set_num_threads(1)
    meta = LeRobotDataset("own/set", root=root).meta
    tactile = [key for key in meta.features if "tactile" in key]
    before = [-1 / meta.fps, 0.0]
    steps = {key: before for key in [*tactile, "observation.state", "observation.tcp_pose"]}
    steps["action"] = [k / meta.fps for k in range(PLANNED)]
    dataset = LeRobotDataset("own/set", root=root, delta_timestamps=steps, video_backend="pyav")
    found = {
        "shuffled": rate(dataset, batch, samples, shuffle=True),
        "in_order": rate(dataset, batch, samples, shuffle=False),
        "version": version("lerobot"),
    }
    out.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
