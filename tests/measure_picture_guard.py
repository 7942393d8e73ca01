"""Print how often the picture guard refuses real frames, whole and with each fault.

    python tests/measure_picture_guard.py DATA

DATA holds mini_presses, digit_presses, digit_parts, physiclear and franka_mini_slip (published real touch).
"""

import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from test_picture_guard import FAULTS, Fault, other_light

from touchgoal.control.tactile.background import local_change
from touchgoal.control.tactile.picture_guard import check_presses, check_untouched
from touchgoal.control.tactile.sensor_models import DIGIT, GELSIGHT_MINI, GELSIGHT_MINI_MARKERS
from touchgoal.runtime.errors import UserError

CHANGES: dict[str, Fault] = {"none": lambda p: p, "other light": other_light}
CHANGES |= {name: fault for name, (fault, _) in FAULTS.items()}
PRESSES = "none", "left to right", "exchanged", "turned"


def read(files: Iterable[Path]) -> list[np.ndarray]:
    return [cv2.imread(str(file))[..., ::-1].copy() for file in sorted(files)]  # pyright: ignore


def clips(files: Iterable[Path], step: int) -> Iterator[tuple[np.ndarray, list[np.ndarray]]]:
    """The untouched picture of each clip (median of 5 frames) and its three firmest frames, apart."""
    for file in sorted(files)[::step]:
        capture, frames = cv2.VideoCapture(str(file)), []
        while (got := capture.read())[0]:
            frames.append(got[1][..., ::-1].copy())
        if len(frames) < 20:
            continue
        untouched = np.median(frames[:5], axis=0).astype(np.uint8)
        parts = np.array_split(np.arange(5, len(frames)), 3)
        strength = [float(local_change(frame, untouched).max()) for frame in frames]
        yield untouched, [frames[max(part, key=lambda i: strength[i])] for part in parts]


def print_table(title: str, names: Iterable[str], groups: dict, check: Callable) -> None:
    """A row a group of pictures, a column a change: how many the check refuses."""
    print(f"\n{title:<28}{'n':>5}" + "".join(f"{name[:13]:>14}" for name in names))
    for group, (model, items) in groups.items():
        counts = dict.fromkeys(names, 0)
        for item, name in ((item, name) for item in items for name in names):
            try:
                check([np.ascontiguousarray(CHANGES[name](p)) for p in item], model)
            except UserError:
                counts[name] += 1
        row = "".join(f"{count:>14}" for count in counts.values())
        print(f"{group:<28}{len(items):>5}{row}", flush=True)


def main(data: Path) -> None:
    mini, digit = (read((data / f"{k}_presses").glob("*.png")) for k in ("mini", "digit"))
    minis = list(clips((data / "physiclear" / "videos").iterdir(), 6))
    dotted = list(clips((data / "franka_mini_slip").glob("*.mp4"), 6))
    groups = {  # the first picture of the presses is background.png
        "Mini, the file's unit": (GELSIGHT_MINI, mini),
        "DIGIT, the file's unit": (DIGIT, digit),
        "DIGIT, another, touched": (DIGIT, read((data / "digit_parts").rglob("*.jpg"))[::4]),
        "Mini, another": (GELSIGHT_MINI, [untouched for untouched, _ in minis]),
        "Mini, another, touched": (GELSIGHT_MINI, [press for _, p in minis for press in p]),
        "Minis with dots": (GELSIGHT_MINI_MARKERS, [untouched for untouched, _ in dotted]),
    }
    alone = {name: (model, [[p] for p in pictures]) for name, (model, pictures) in groups.items()}
    print_table("refused pictures", CHANGES, alone, lambda p, m: check_untouched(p[0], m, "it"))
    sets = {
        "Mini, the file's unit": (GELSIGHT_MINI, [[mini[0], *mini[1 + i :: 8]] for i in range(8)]),
        "DIGIT, the file's unit": (DIGIT, [[digit[0], *digit[1 + i :: 4]] for i in range(4)]),
        "Mini, another, by clip": (GELSIGHT_MINI, [[untouched, *p] for untouched, p in minis[::3]]),
    }
    check = lambda p, m: check_presses(p[0], p[1:], m, "it")  # noqa: E731
    print_table("refused sets of presses", PRESSES, sets, check)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
