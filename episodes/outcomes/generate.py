"""Failures made from the pictures of one recorded success, where none were recorded.

They need no simulator and no robot, and are cruder than real failures: a cost that misses them is
bad, one that finds them all may still miss real ones. Only pictures are kept; joints, forces and
truth of the success would contradict them.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Int, UInt8

from touchgoal.control.features import TACTILE
from touchgoal.episodes.schema import Episode, is_image
from touchgoal.episodes.touches import contact_per_frame, touch_background
from touchgoal.runtime.errors import UserError

_UNTOUCHED = 5  # first frames, which must be free of contact
_AMPLIFIED = 2.0  # by which a touch that presses too hard changes the gel's picture
Frames = dict[str, np.ndarray]


def made_failures(episode: Episode, other: Episode) -> dict[str, Episode]:
    """Return every failure that can be made from a success, by kind.

    `other` is an episode with another object, whose touch the wrong object gets. UserError: an
    episode without touch or camera, one that never touches, or fewer than 5 frames before it does.
    """
    frames = {key: values for key, values in episode.frames.items() if is_image(key)}
    contact = _first_contact(frames)
    meta = {k: v for k, v in episode.meta.items() if k not in ("outcome", "success")}
    made = {name: make(frames, contact, other.frames) for name, make in _KINDS.items()}
    return {
        name: Episode(changed, episode.task, {**meta, "outcome": f"made_{name}", "success": False})
        for name, changed in made.items()
    }


def _first_contact(frames: Frames) -> int:
    sides = [key for key in TACTILE if key in frames]
    if not sides or len(sides) == len(frames):
        raise UserError("failures are made from episodes with a camera and touch")
    touching = np.stack([contact_per_frame(frames[side]) for side in sides]).any(axis=0)
    first = int(touching.argmax())
    if not touching.any() or first < _UNTOUCHED:
        raise UserError(
            f"failures are made from successes that touch after at least {_UNTOUCHED} frames"
        )
    return first


def _never_touch(frames: Frames, contact: int, other: Frames) -> Frames:
    """The hand closes on nothing: cameras as recorded, fingertips untouched to the end."""
    return _touch(frames, lambda side: _untouched(side, len(side)))


def _freeze(frames: Frames, contact: int, other: Frames) -> Frames:
    """Cameras and touch repeat the last frame before contact."""
    return _played(frames, np.minimum(np.arange(_length(frames)), contact - 1))


def _drop(frames: Frames, contact: int, other: Frames) -> Frames:
    """Lose the object half-way from contact to the end: no touch from then on, the cameras stand still."""
    lost = (contact + _length(frames)) // 2
    held = _played(frames, np.minimum(np.arange(_length(frames)), lost))
    return _touch(
        held, lambda side: np.concatenate([side[:lost], _untouched(side, len(side) - lost)])
    )


def _rewind(frames: Frames, contact: int, other: Frames) -> Frames:
    """Play everything backwards from half-way between contact and the end."""
    turn = (contact + _length(frames)) // 2
    return _played(frames, np.concatenate([np.arange(turn), np.arange(turn)[::-1]]))


def _over_press(frames: Frames, contact: int, other: Frames) -> Frames:
    """Double the gel picture's change: roughly a deeper press, without its wider contact."""

    def pressed(side: UInt8[np.ndarray, "n h w 3"]) -> UInt8[np.ndarray, "n h w 3"]:
        background = touch_background(side).astype(np.float32)
        return np.rint(background + _AMPLIFIED * (side - background)).clip(0, 255).astype(np.uint8)

    return _touch(frames, pressed)


def _wrong_object(frames: Frames, contact: int, other: Frames) -> Frames:
    """Touch is that of another episode, stretched to this one's length."""
    missing = [key for key in TACTILE if key in frames and key not in other]
    if missing:
        raise UserError(f"the other episode has no {' and '.join(missing)}")
    rows = np.rint(np.linspace(0, _length(other) - 1, _length(frames))).astype(int)
    return {key: other[key][rows] if key in TACTILE else v for key, v in frames.items()}


def _swapped_colours(frames: Frames, contact: int, other: Frames) -> Frames:
    """Red and blue are exchanged in every picture, as by a driver that delivers BGR."""
    return {key: values[..., ::-1] for key, values in frames.items()}


_KINDS: dict[str, Callable[[Frames, int, Frames], Frames]] = {
    "never_touch": _never_touch,
    "freeze": _freeze,
    "drop": _drop,
    "rewind": _rewind,
    "over_press": _over_press,
    "wrong_object": _wrong_object,
    "swapped_colours": _swapped_colours,
}
MADE = tuple(_KINDS)  # kinds of failure that `made_failures` makes


def _length(frames: Frames) -> int:
    return max(len(values) for key, values in frames.items() if is_image(key))


def _played(frames: Frames, rows: Int[np.ndarray, " m"]) -> Frames:
    """Return the pictures of all cameras and fingertips in this order of frames."""
    return {key: values[rows] for key, values in frames.items()}


def _touch(frames: Frames, change: Callable[[np.ndarray], np.ndarray]) -> Frames:
    """Return the pictures with those of each fingertip changed."""
    return {key: change(v) if key in TACTILE else v for key, v in frames.items()}


def _untouched(
    side: UInt8[np.ndarray, "n h w 3"], length: int
) -> UInt8[np.ndarray, "length h w 3"]:
    """Return the first frames in turn, so that the sensor's noise goes on."""
    return side[np.arange(length) % _UNTOUCHED]
