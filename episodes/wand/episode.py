"""The episode of a wand's touch, simulated or real: six frames, the same keys and facts in both.

The tactile clip is at the sensor's rate; the views beside it change once, at contact.
"""

from dataclasses import dataclass

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.tactile.gel_wear import GelWear
from touchgoal.control.wand_touch import CLIP, WandTouch
from touchgoal.episodes.schema import Episode

FPS = 25  # images a second of a GelSight Mini
SET = "wand"  # meta: where the touches of a set come from; sets of another origin are not continued
_BEFORE = 2  # frames of a clip that show the views before contact


@dataclass(frozen=True)
class Visit:
    """One stay of an object on the bench."""

    origin: str  # of the set, see `SET`
    sensor: str  # on the wand
    object: str  # its name
    descriptions: tuple[str, ...]  # how the object feels, in words
    gel: int  # which gel is on the wand
    number: int  # of the visit in the set


def wand_episode(touch: WandTouch, visit: Visit, wear: GelWear | None) -> Episode:
    """Return a touch as an episode; `wear` is the gel's after it."""
    frames = {
        key: np.stack([touch.before[view]] * _BEFORE + [touch.views[view]] * (CLIP - _BEFORE))
        for key in ft.WAND_VIEWS
        if (view := key.removeprefix(ft.IMAGE_PREFIX)) in touch.views
    }
    frames |= {ft.TACTILE_LEFT: touch.clip, ft.LOAD: touch.load[:, None]}
    meta = {
        SET: visit.origin,
        "sensor": visit.sensor,
        "object": visit.object,
        "descriptions": list(visit.descriptions),
        "gel": visit.gel,
        "gel_wear": wear.kind if wear else "",
        "visit": visit.number,
        "force": float(touch.load[-1]),
        "untouched_frames": 1,
    }
    return Episode(frames, f"touch the {visit.object.replace('_', ' ')} with the wand", meta)
