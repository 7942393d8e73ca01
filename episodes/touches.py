"""Touches: single tactile frames with the object in contact, drawn from episodes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int, UInt8

from touchgoal.control.arrays import Image
from touchgoal.control.features import TACTILE, TACTILE_LEFT, TRUTH_CONTACT, WRIST
from touchgoal.control.sensors.exchanged import fingertips_exchanged
from touchgoal.control.tactile.background import (
    SETTLES_WITHIN,
    Background,
    local_change,
    untouched_frames,
)
from touchgoal.control.tactile.contact import ContactDetector, coarse, threshold_for
from touchgoal.control.tactile.image_guard import check_unpressed, check_untouched
from touchgoal.control.tactile.sensor_models import SENSORS, SensorModel
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

_VIEW_FRAMES_BEFORE_CONTACT = 5
# counts of local change of one sensor between two days; noise of 1 count gives 0.3
_SAME_SENSOR = 1.0
_LOOKED_AT = 8  # episodes of a set whose first frames are checked


@dataclass(frozen=True, eq=False)
class Touches:
    """n tactile frames of e episodes, with b backgrounds: one per episode and side."""

    frames: UInt8[np.ndarray, "n h w 3"]  # raw sensor RGB, one side each
    background: UInt8[np.ndarray, "b h w 3"]  # untouched, per episode and side
    background_index: Int[np.ndarray, " n"]  # row of `background` for each frame
    view: UInt8[np.ndarray, "e H W 3"]  # wrist image of the bare object, one per episode
    view_index: Int[np.ndarray, " n"]  # row of `view` for each frame
    object: tuple[str, ...]  # catalogue id of what each frame touches; "" without contact
    descriptions: dict[str, list[str]]  # catalogue id -> sentences on how the object feels

    def __len__(self) -> int:
        return len(self.frames)


def collect_touches(
    episodes: EpisodeSet,
    contact_frames_per_episode: int,
    no_contact_frames_per_episode: int,
    seed: int,
) -> Touches:
    """Draw frames with and without contact from both fingertips of every episode.

    Contact is the simulator's if the set has it, else a `ContactDetector`'s. The background is the
    median of a side's first 5 frames. The view is the wrist image 5 frames before the last one
    without contact on either side (the first, if that is earlier or there is no contact), when the
    hand does not yet hide the object. An episode with fewer frames of a kind gives all it has.
    UserError: the set lacks the images or the meta, or has no contact.

    Args:
        episodes: Set whose meta has `object` and `descriptions`.
        contact_frames_per_episode: Number of frames in contact, both sides together.
        no_contact_frames_per_episode: Number of frames without contact on their side.
        seed: Random seed; an episode's draw does not depend on the other episodes.
    """
    if WRIST not in episodes.features:
        raise UserError(f"{episodes.root} has no wrist images: record {WRIST} too")
    sides = check_touches(episodes)
    most = len(episodes) * (contact_frames_per_episode + no_contact_frames_per_episode)
    frames = np.empty((most, *episodes.features[TACTILE[sides[0]]]["shape"]), np.uint8)
    sampled, backgrounds, views, filled = [], [], [], 0
    for i in track(range(len(episodes)), "drawing touches", "episode"):
        drawn = draw_frames(
            episodes, i, contact_frames_per_episode, no_contact_frames_per_episode, seed
        )
        n = len(drawn.frames)
        frames[filled : filled + n] = drawn.frames
        filled += n
        sampled.append(np.column_stack([np.full(n, i), drawn.column, drawn.in_contact]))
        backgrounds += drawn.background
        views.append(_view(episodes, i, drawn.contact))
    episode_index, column, in_contact = np.concatenate(sampled).T
    if not in_contact.any():
        raise UserError(f"{episodes.root} has no contact: give episodes with contact")
    names = [str(episodes.meta(i)["object"]) for i in range(len(episodes))]
    return Touches(
        frames=frames[:filled],
        background=np.stack(backgrounds),
        background_index=episode_index * len(sides) + column,
        view=np.stack(views),
        view_index=episode_index,
        object=tuple(names[i] if f else "" for i, f in zip(episode_index, in_contact, strict=True)),
        descriptions=descriptions(episodes),
    )


@dataclass(frozen=True, eq=False)
class DrawnFrames:
    """n frames drawn from one episode of t ticks with s fingertips."""

    frames: UInt8[np.ndarray, "n h w 3"]  # raw sensor RGB, one side each
    column: Int[np.ndarray, " n"]  # fingertip of each frame, counted among those recorded
    in_contact: Bool[np.ndarray, " n"]  # of each frame
    background: list[Image]  # of each fingertip, untouched
    contact: Bool[np.ndarray, "t s"]  # of every tick


def draw_frames(
    episodes: EpisodeSet, i: int, contact_frames: int, no_contact_frames: int, seed: int
) -> DrawnFrames:
    """Draw frames of one episode, see `collect_touches`."""
    sides = _sides(episodes)
    contact = _contact(episodes, i, sides)
    rng = np.random.default_rng([seed, i])
    picked = np.concatenate(
        [
            _sample_frames(contact, contact_frames, rng),
            _sample_frames(~contact, no_contact_frames, rng),
        ]
    )
    frames = np.empty((len(picked), *episodes.features[TACTILE[sides[0]]]["shape"]), np.uint8)
    for column, side in enumerate(sides):
        rows, key = np.flatnonzero(picked[:, 1] == column), TACTILE[side]
        frames[rows] = episodes.read(i, [key], picked[rows, 0].tolist()).frames[key]
    first = _first_frames(episodes, i, [TACTILE[side] for side in sides])
    background = [touch_background(images) for images in first.values()]
    in_contact = contact[picked[:, 0], picked[:, 1]]
    return DrawnFrames(frames, picked[:, 1], in_contact, background, contact)


def _sides(episodes: EpisodeSet) -> list[int]:
    return [side for side, key in enumerate(TACTILE) if key in episodes.features]


def check_touches(episodes: EpisodeSet) -> list[int]:
    """Return the sides of a set; UserError if it lacks touch or descriptions."""
    sides = _sides(episodes)
    if not sides:
        raise UserError(f"{episodes.root} has no touch: record {TACTILE_LEFT} too")
    if missing := {"object", "descriptions"} - set(episodes.meta(0)):
        raise UserError(f"{episodes.root} lacks meta {', '.join(sorted(missing))}: record them")
    check_fingertips(episodes, range(len(episodes)))
    return sides


def check_fingertips(episodes: EpisodeSet, chosen: Sequence[int]) -> None:
    """Refuse a set whose fingertip images are not its sensor's, or in which left and right change places.

    The first frames of some episodes are compared with the sensor file, and with each other.

    UserError: see `check_touch`; or two episodes have them exchanged.
    """
    keys = [key for key in TACTILE if key in episodes.features]
    looked_at = [chosen[i] for i in np.linspace(0, len(chosen) - 1, _LOOKED_AT).astype(int)]
    first: list[UInt8[np.ndarray, "h w 3"]] = []
    for i in sorted(set(looked_at)) if keys else ():
        read = _first_frames(episodes, i, keys)
        frames = [read[key][0] for key in keys]
        sensor = SENSORS.get(str(episodes.meta(i).get("sensor")))
        for key in keys:
            if sensor is not None:
                check_touch(read[key], sensor, f"{key} of episode {i} of {episodes.root}")
        first = first or frames
        if len(keys) == 2 and _exchanged((frames[0], frames[1]), (first[0], first[1])):
            raise UserError(
                f"{episodes.root}: left and right fingertip of episode {i} look exchanged against episode "
                f"{looked_at[0]}: exchange {keys[0]} and {keys[1]} in one of them, or leave it out"
            )


def _exchanged(frames: tuple[Image, Image], first: tuple[Image, Image]) -> bool:
    """Whether the same two sensors changed sides; new sensors, as simulation draws them, do not count."""
    crossed = max(float(local_change(frames[k], first[1 - k]).mean()) for k in (0, 1))
    return crossed < _SAME_SENSOR and fingertips_exchanged(frames, first)


def check_touch(frames: UInt8[np.ndarray, "n h w 3"], sensor: SensorModel, name: str) -> None:
    """Refuse a fingertip whose first frames contradict its sensor file, are pressed, or too compressed.

    `name` is for the UserError; see `image_guard` and `contact.coarse`.
    """
    background = touch_background(frames)
    check_untouched(background, sensor, name)
    check_unpressed(frames[0], sensor, name)  # a hand may close within five frames
    if wrong := coarse(threshold_for(untouched_frames(frames), background)):
        raise UserError(f"{name}: {wrong}")


def touch_background(frames: UInt8[np.ndarray, "n h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return a fingertip's background, for training and rewards: the median of 5 frames.

    They are the first ones in steady light (`untouched_frames`).
    """
    return np.median(untouched_frames(frames), axis=0).astype(np.uint8)


def contact_detector(frames: UInt8[np.ndarray, "n h w 3"]) -> ContactDetector:
    """Return a detector of contact, whose background and threshold the first frames give."""
    untouched, background = untouched_frames(frames), touch_background(frames)
    return ContactDetector(Background(background[None]), threshold_for(untouched, background))


def _first_frames(episodes: EpisodeSet, i: int, keys: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the frames of fingertips in which the light settles."""
    return episodes.read(i, keys, range(min(SETTLES_WITHIN, episodes.lengths[i]))).frames


def _contact(episodes: EpisodeSet, i: int, sides: list[int]) -> Bool[np.ndarray, "t s"]:
    if TRUTH_CONTACT in episodes.features:
        return episodes.read(i, [TRUTH_CONTACT]).frames[TRUTH_CONTACT][:, sides]
    contact = []
    for images in episodes.read(i, [TACTILE[side] for side in sides]).frames.values():
        detector = contact_detector(images)
        contact.append([detector.update(image) for image in images])
    return np.array(contact, bool).T


def _sample_frames(
    mask: Bool[np.ndarray, "t s"], count: int, rng: np.random.Generator
) -> Int[np.ndarray, "k 2"]:
    """Draw at most `count` (frame, column) pairs where the mask is true, in order of time."""
    places = np.argwhere(mask)
    return places[np.sort(rng.permutation(len(places))[:count])]


def _view(
    episodes: EpisodeSet, i: int, contact: Bool[np.ndarray, "t s"]
) -> UInt8[np.ndarray, "H W 3"]:
    touched = np.flatnonzero(contact.any(axis=1))
    frame = max(int(touched[0]) - 1 - _VIEW_FRAMES_BEFORE_CONTACT, 0) if len(touched) else 0
    return episodes.read(i, [WRIST], [frame]).frames[WRIST][0]


def descriptions(episodes: EpisodeSet) -> dict[str, list[str]]:
    """Return the distinct sentences on each object, in the order in which they appear."""
    sentences_of: dict[str, dict[str, None]] = {}
    for i in range(len(episodes)):
        meta = episodes.meta(i)
        sentences = meta["descriptions"]
        if not isinstance(sentences, list):
            raise UserError(f"{episodes.root}: meta descriptions must be a list of str")
        sentences_of.setdefault(str(meta["object"]), {}).update(dict.fromkeys(sentences))
    return {name: list(sentences) for name, sentences in sentences_of.items()}
