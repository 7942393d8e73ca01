"""Sets between touchgoal and lerobot, both ways, compared bit for bit; `make interop-lerobot` runs it.

    python tests/interop/lerobot_run.py PYTHON      PYTHON: of an environment with lerobot[dataset]

Episodes of the toy arm go to lerobot, which deletes, splits and merges them; sets of its own come back.
Each one is read by both. Then reward-curves measures an edited one, and lerobot trains a step of ACT on
ours.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
from toy_episodes import record  # noqa: E402

from touchgoal.episodes.faults import find_faults  # noqa: E402
from touchgoal.episodes.format.foreign import ForeignSetError  # noqa: E402
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter  # noqa: E402


def largest_difference(root: Path) -> float:
    """Read every frame of a set and compare it with what lerobot's reader returned."""
    episodes, expected = EpisodeSet(root), np.load(root.with_suffix(".npz"))
    first, largest = 0, 0.0
    for i, length in enumerate(episodes.lengths):
        rows = slice(first, first := first + length)
        episode = episodes.read(i)
        assert episode.task == str(expected["task"][rows][0])
        for key, values in episode.frames.items():
            theirs = expected[key][rows].reshape(values.shape).astype(float)
            largest = max(largest, float(np.abs(theirs - values.astype(float)).max()))
    assert first == len(expected["task"]) and not find_faults(episodes, range(len(episodes)))
    return largest


def is_refused(root: Path) -> bool:
    """Whether touchgoal refuses to append to a set."""
    try:
        EpisodeWriter(root, EpisodeSet(root).fps)
    except ForeignSetError:
        return True
    return False


def main() -> None:
    python = sys.argv[1]
    with tempfile.TemporaryDirectory() as folder:
        own, out = Path(folder) / "own", Path(folder) / "sets"
        record(own, range(3), n=40)
        subprocess.run([python, HERE / "lerobot_sets.py", own, out], check=True)
        results = []
        print(f"{'set':<18}{'episodes':>9}{'largest difference':>20}{'appending refused':>19}")
        for root in sorted(path for path in out.iterdir() if path.is_dir()):
            difference, refused = largest_difference(root), is_refused(root)
            print(f"{root.name:<18}{len(EpisodeSet(root)):>9}{difference:>20g}{refused!s:>19}")
            results.append(difference == 0 and refused == (root.name != "own"))
        for name in ("created_deleted", "own_merged"):
            command = [sys.executable, "-m", "touchgoal.launch", "reward-curves", out / name]
            command += ["--towers", "offline", "--index", "0", "--out", out / f"{name}_curves"]
            camera = ["--camera", "wrist"] if name.startswith("own") else []
            subprocess.run([*command, *camera], check=True, stdout=subprocess.DEVNULL)
            print(f"reward-curves of {name}: done")
        subprocess.run([python, HERE / "lerobot_training_step.py", own], check=True)
    sys.exit(0 if all(results) else "some sets are not read as lerobot reads them")


if __name__ == "__main__":
    main()
