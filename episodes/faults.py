"""Faults in sets that touchgoal did not write: faulty episodes are named and left out before any work."""

import sys
from collections.abc import Sequence

import numpy as np

from touchgoal.episodes.schema import is_image
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

_RATE = 0.01  # relative difference between the rates of video and table
_SHOWN = 20  # lines


def leave_out_faulty(
    episodes: EpisodeSet, chosen: Sequence[int], keys: Sequence[str] | None = None
) -> list[int]:
    """Return the chosen episodes without a fault in these keys; the others are listed on stderr.

    UserError: none is left.
    """
    faults = find_faults(episodes, chosen, keys)
    lines = list(faults.values())
    if chosen and len(faults) == len(chosen):
        raise UserError(f"no episode of {episodes.root} can be used: {lines[0]}")
    if faults:
        print(f"{len(faults)} of {len(chosen)} episodes are left out:", file=sys.stderr)
        shown = [*lines[:_SHOWN], *[f"and {len(lines) - _SHOWN} more"] * (len(lines) > _SHOWN)]
        print("\n".join(f"  {line}" for line in shown), file=sys.stderr)
    return [i for i in chosen if i not in faults]


def find_faults(
    episodes: EpisodeSet, chosen: Sequence[int], keys: Sequence[str] | None = None
) -> dict[int, str]:
    """Return the first fault of each faulty episode, with its frame.

    Checks these keys, by default all. Surplus frames at the end of a video are no fault: they are told
    on stderr. Touchgoal's own sets are not checked: its writer refuses such
    episodes, and checksums cover the rest.
    """
    if not episodes.foreign:
        return {}
    keys = list(episodes.features) if keys is None else keys
    found = ((i, _fault(episodes, i, keys)) for i in track(chosen, "checking", "episode"))
    return {i: f"episode {i} of {episodes.root}: {fault}" for i, fault in found if fault}


def _fault(episodes: EpisodeSet, i: int, keys: Sequence[str]) -> str | None:
    try:
        if fault := _time_fault(episodes.stored_numbers(i, "timestamp")[:, 0], episodes.fps):
            return fault
        for key in keys:
            if episodes.features[key]["dtype"] == "video":
                fault = _video_fault(episodes, i, key)
            elif not is_image(key):
                fault = _number_fault(episodes, i, key)
            if fault:
                return fault
    except UserError as error:
        return str(error)
    return None


def _time_fault(stamps: np.ndarray, fps: float) -> str | None:
    """Name the first time stamp that repeats, or is half a frame or more from its place.

    Smaller jitter is no fault: frames are found by their number.
    """
    expected = np.arange(len(stamps)) / fps
    wrong = ~(np.abs(stamps - stamps[0] - expected) < 0.5 / fps)
    wrong[1:] |= ~(np.diff(stamps) > 0)
    if not wrong.any():
        return None
    k = int(np.argmax(wrong))
    before = f" after {stamps[k - 1]:.3f} s" if k else ""
    return f"frame {k} has the time stamp {stamps[k]:.3f} s{before}, at {fps:g} frames per second"


def _video_fault(episodes: EpisodeSet, i: int, key: str) -> str | None:
    length = episodes.lengths[i]
    stated, left, fps = episodes.video_length(i, key)
    if abs(fps - episodes.fps) > _RATE * episodes.fps:
        return f"{key} is a video of {fps:g} frames per second, the table has {episodes.fps:g}"
    if min(stated, left) < length:
        return f"{key} ends at frame {max(min(stated, left), 0)}, the table at frame {length}"
    if stated > length:
        surplus = f"{key} has {stated - length} frames more than the table"
        print(f"episode {i} of {episodes.root}: {surplus}, which are left out", file=sys.stderr)
    return None


def _number_fault(episodes: EpisodeSet, i: int, key: str) -> str | None:
    values = episodes.stored_numbers(i, key)
    if values.dtype.kind != "f" or np.isfinite(values).all():
        return None
    return f"{key} is not finite at frame {int(np.argwhere(~np.isfinite(values))[0][0])}"
