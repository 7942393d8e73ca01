"""Lists of VisGel (Li et al., CVPR 2019): camera and tactile images of recordings that touch once.

Published layout (github.com/YunzhuLi/VisGel): `data_lst/train_touch2vision.txt` (or `eval`, `demo`;
`vision2touch`) beside `data/data_seen` and `data/data_unseen`. A line holds 8 paths with single spaces
between them, relative to the folder that holds `data_lst`: reference image, reference touch, image,
touch, and the two images before and the two after. In the lists of touch2vision touches and images
change places, so the last four are touches. Both kinds lie in folders of one name,
`images/vision/0/rec_00000/frame0000.jpg` and `images/touch/0/rec_00000/frame0000.jpg`.
"""

import re
import sys
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from touchgoal.runtime.errors import UserError

_PATHS = 8
_WORDS_IN_PATHS = "touch", "vision"  # folder names

Step = tuple[str, str]  # camera image and tactile image of one time, as the list names them


@dataclass(frozen=True)
class VisGelRecording:
    """One recording of n time steps."""

    name: str  # folder of its tactile images, as the list names it
    reference: Step  # camera and tactile image without contact
    steps: tuple[Step, ...]  # camera and tactile images in time
    video: tuple[str, ...]  # all its camera images in time, at least those of `steps`


def read_visgel_list(path: Path) -> list[VisGelRecording]:
    """Read the recordings of a list, in the order in which it names them first.

    UserError: it cannot be read, is empty, or a line has not 8 paths.
    """
    steps: defaultdict[str, set[Step]] = defaultdict(set)
    videos: defaultdict[str, set[str]] = defaultdict(set)
    references: dict[str, Step] = {}
    try:
        with path.open(encoding="utf-8") as lines:
            for number, line in enumerate(lines, 1):
                if not line.strip():
                    continue
                reference, step, others = _parse(line, f"{path}:{number}", path)
                name = str(PurePosixPath(step[1]).parent)
                references.setdefault(name, reference)
                steps[name].add(step)
                videos[name].update((step[0], *others))
    except OSError as error:
        raise UserError(f"cannot read the list {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is no text: give a list such as train_touch2vision.txt") from error
    if not references:
        raise UserError(f"{path} is empty: give a list such as train_touch2vision.txt")
    return [
        VisGelRecording(
            name,
            reference,
            tuple(sorted(steps[name], key=lambda step: _time(step[1]))),
            tuple(sorted(videos[name], key=_time)),
        )
        for name, reference in references.items()
    ]


def find_root(path: Path, root: Path | None, recording: VisGelRecording) -> Path:
    """Return the folder that a list's paths are relative to: `root`, or the one that holds `data_lst`.

    UserError: the recording's reference is not there.
    """
    found = root or path.resolve().parent.parent
    if not (found / recording.reference[0]).is_file():
        raise UserError(
            f"there is no {found / recording.reference[0]}, which {path} names: give the folder that "
            "its paths are relative to with --root"
        )
    return found


def _parse(line: str, where: str, path: Path) -> tuple[Step, Step, tuple[str, ...]]:
    """Return a line's reference, its step, and further camera images."""
    paths = [sys.intern(word) for word in line.split()]  # neighbouring lines name the same files
    if len(paths) != _PATHS:
        raise UserError(
            f"{where} has {len(paths)} paths, not {_PATHS}: give a list of VisGel, as published"
        )
    # one of touch2vision: by its third path's folders, else by its name
    kinds = [part for part in PurePosixPath(paths[2]).parts if part in _WORDS_IN_PATHS]
    if kinds[-1] == "touch" if kinds else "touch2vision" in path.name:
        return (paths[1], paths[0]), (paths[3], paths[2]), ()
    return (paths[0], paths[1]), (paths[2], paths[3]), tuple(paths[4:])


def _time(path: str) -> tuple[list[int], str]:
    """Return the sort key of a frame: the numbers in its name, so that frame10 follows frame9."""
    name = PurePosixPath(path).name
    return [int(digits) for digits in re.findall(r"\d+", name)], path
