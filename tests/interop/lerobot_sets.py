"""Written, edited and read by lerobot itself, for `lerobot_run.py`; runs in lerobot's environment.

    python lerobot_sets.py OWN OUT      OWN: a set that touchgoal recorded

Each set OUT/NAME gets OUT/NAME.npz: what lerobot's own reader returns for it.
"""

import shutil
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets, split_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset

ARM = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
FPS = 15


def features(video: bool) -> dict:
    image = {"shape": (96, 128, 3), "names": ["height", "width", "channels"]}
    numbers = {"dtype": "float32", "shape": (6,), "names": [f"{name}.pos" for name in ARM]}
    return {
        "observation.images.top": {"dtype": "video" if video else "image", **image},
        "observation.state": numbers,
        "action": numbers,
        "next.done": {"dtype": "bool", "shape": (1,), "names": None},
    }


def add_episode(dataset: LeRobotDataset, seed: int) -> None:
    """A blob moves over a gradient; the state follows it."""
    rng = np.random.default_rng(seed)
    n, (x, y) = 20 + seed, rng.uniform(20, 70, 2)
    rows, columns = np.mgrid[:96, :128]
    for t in range(n):
        x, y = x + rng.normal(), y + rng.normal()
        bright = 200 * np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / 200)
        image = np.stack([bright, columns, np.full((96, 128), 10 * seed)], -1).astype(np.uint8)
        state = rng.normal(size=6).astype(np.float32)
        dataset.add_frame(
            {
                "observation.images.top": image,
                "observation.state": state,
                "action": state + 0.1,
                "next.done": np.array([t == n - 1]),
                "task": "put it down" if seed % 3 == 1 else "pick up the ball",
            }
        )
    dataset.save_episode()


def read(root: Path) -> LeRobotDataset:
    return LeRobotDataset("toy/toy", root=root, video_backend="pyav", return_uint8=True)


def create(root: Path, seeds: range, video: bool = True) -> None:
    dataset = LeRobotDataset.create("toy/toy", FPS, features(video), root, "so101")
    for seed in seeds:
        add_episode(dataset, seed)
    dataset.finalize()


def resume(source: Path, root: Path, seeds: range) -> None:
    shutil.copytree(source, root)
    dataset = LeRobotDataset.resume("toy/toy", root)
    for seed in seeds:
        add_episode(dataset, seed)
    dataset.finalize()


def edit(source: Path, out: Path, name: str) -> None:
    """Delete, split and merge; the reader at the end of each call finds the result."""
    delete_episodes(read(source), [1], out / f"{name}_deleted", "toy/deleted")
    split = split_dataset(read(source), {"first": [0], "rest": [1, 2]}, out)
    for part, dataset in split.items():
        Path(dataset.root).rename(out / f"{name}_{part}")
    merge_datasets([read(source), read(source)], "toy/merged", out / f"{name}_merged")


def dump(root: Path) -> None:
    dataset, found = read(root), {}
    items = [dataset[i] for i in range(len(dataset))]
    for key in dataset.features:
        values = np.stack([np.asarray(item[key]) for item in items])
        if values.ndim == 4:
            scaled = values if values.dtype == np.uint8 else np.rint(values * 255).astype(np.uint8)
            values = scaled.transpose(0, 2, 3, 1)
        found[key] = values
    found["task"] = np.array([item["task"] for item in items])
    np.savez(root.with_suffix(".npz"), **found)


def main() -> None:
    own, out = (Path(name) for name in sys.argv[1:])
    create(out / "created", range(3))
    create(out / "images", range(3), video=False)
    resume(out / "created", out / "resumed", range(3, 5))
    edit(out / "created", out, "created")
    edit(own, out, "own")
    for info in sorted(out.glob("*/meta/info.json")):
        dump(info.parents[1])
    dump(shutil.copytree(own, out / "own"))


if __name__ == "__main__":
    main()
