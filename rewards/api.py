"""Reward curves from arrays, in one call."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from touchgoal.control.features import CONTROL_HZ, FRONT, TACTILE, TACTILE_LEFT, TACTILE_RIGHT
from touchgoal.encoders import pretrained
from touchgoal.encoders.preprocess import check_pictures
from touchgoal.encoders.pretrained import AnyTouchEncoder
from touchgoal.encoders.towers.towers import Towers, load_towers
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.touches import touch_background
from touchgoal.rewards.curves import Curves
from touchgoal.rewards.embedding_distance import EpisodeEmbedder, check_words, compute_curves
from touchgoal.rewards.goals import (
    FrameNumber,
    GoalSpec,
    Modality,
    PictureArray,
    Sentence,
    TouchArrays,
    assign_goals,
    check_goal,
    parse_goal,
)
from touchgoal.rewards.normalizer import DistanceNormalizer
from touchgoal.rewards.setup import own_towers
from touchgoal.runtime.errors import UserError

GoalLike = str | int | np.ndarray | Mapping[str, np.ndarray]
"""A goal as a script has it; see `reward_curve`."""

_SIDES = {"left": TACTILE_LEFT, "right": TACTILE_RIGHT}
_FORMS = ("frame:", "image:", "episode:", "text:")


def reward_curve(
    images: np.ndarray | None = None,
    tactile: Mapping[str, np.ndarray] | None = None,
    goal: GoalLike | list[GoalLike] | tuple[GoalLike, ...] = "last",
    encoder: str | Path | AnyTouchEncoder | None = None,
    *,
    towers: str | Towers | None = None,
    normalizer: str | Path | DistanceNormalizer | None = None,
    camera: str = FRONT,
    fps: float = CONTROL_HZ,
) -> Curves:
    """How far a trajectory is from a goal, frame by frame, in each modality: costs and rewards.

        curves = reward_curve(images, {"left": left, "right": right}, goal=("last", "a hard ball"))
        curves.costs["tactile"]  # (T,): cosine distance to the goal, 0 at the goal
        curves.rewards["image"]  # (T,): -cost
        curves.potential_rewards(gamma=0.99)["text"]  # (T,): gamma * Phi' - Phi with Phi = -cost

    Args:
        images: camera pictures, uint8 (T, height, width, 3), RGB.
        tactile: pictures of the fingertip sensors, "left", "right" or both, each as `images`. The
            first 5 must be free of contact: they are the background.
        goal: one, or several of which each modality takes the first that speaks for it:
            "last" or a frame number, for the same frame of this trajectory (image and touch);
            an array (height, width, 3), a camera picture;
            arrays by name, {"image": ..., "left": ..., "right": ...}, each (height, width, 3),
            of the goal state (touch with the same fingertips as here, untouched as here);
            a sentence on how the object feels (touch; or pictures, with the towers of a CLIP and
            without tactile); or any form of `reward-curves --goal`, such as "episode:data/set#3".
        encoder: touch encoder of any kind: a name ("gelsight_mini"), a folder, or one already loaded; a
            sentence as goal needs one that is aligned with texts. Default: the one that ships for the
            GelSight Mini.
        towers: "offline", a CLIP's Hugging Face id or folder, or loaded ones. Default: those that
            the encoder was trained with, "offline" without tactile.
        normalizer: what normalises distances and lets them be fused: a file that `touchgoal fit-normalizer`
            wrote, or one already read. Default: none, raw cosine distances.
        camera: vocabulary key of the camera, for the normalizer.
        fps: frames per second.

    Returns:
        `costs`, `rewards` and `potential_rewards(gamma)` by modality, each (T,), and `metrics()`.

    Raises:
        UserError: arrays that are no such pictures or do not match, a goal that nothing takes.
    """
    episode = _as_episode(images, tactile, camera)
    goals = list(goal) if isinstance(goal, list | tuple) else [goal]
    specs = [spec for one in goals for spec in _as_specs(one, episode)]
    sides = [key for key in TACTILE if key in episode.frames]
    image: tuple[Modality, ...] = ("image",) if camera in episode.frames else ()
    touch_encoder = _touch_encoder(encoder) if sides else None
    check_words(specs, touch_encoder)
    aligned = touch_encoder is not None and touch_encoder.towers is not None
    touch: tuple[Modality, ...] = ("tactile", *(("text",) if aligned else ())) if sides else ()
    modalities: tuple[Modality, ...] = (*image, *touch)
    towers = own_towers(touch_encoder) if towers is None else towers
    if isinstance(towers, str):
        towers = load_towers(towers)
    assigned = assign_goals(specs, modalities, towers.pretrained_together)
    check_goal(assigned, len(episode), "this trajectory", camera, sides)
    if isinstance(normalizer, str | Path):
        normalizer = DistanceNormalizer.load(Path(normalizer))
    embedder = EpisodeEmbedder(towers, touch_encoder, camera)
    embedded = embedder.embed_episode(episode, fps, "this trajectory")
    return compute_curves(embedded, embedder.embed_goal(assigned, embedded), normalizer)


def _as_episode(
    images: np.ndarray | None, tactile: Mapping[str, np.ndarray] | None, camera: str
) -> Episode:
    frames = {} if images is None else {camera: images}
    for side, pictures in (tactile or {}).items():
        if side not in _SIDES:
            raise UserError(f"tactile has no '{side}': give left, right or both")
        frames[_SIDES[side]] = pictures
    if not frames:
        raise UserError("nothing to measure: give images, tactile or both")
    names = {key: side for side, key in _SIDES.items()} | {camera: "images"}
    for key, pictures in frames.items():
        check_pictures(names[key], pictures, ndim=(4,))
    lengths = {names[key]: len(pictures) for key, pictures in frames.items()}
    if len(set(lengths.values())) > 1:
        said = ", ".join(f"{name} {n}" for name, n in lengths.items())
        raise UserError(f"images and tactile must have equally many frames, not {said}")
    if min(lengths.values()) < 2:
        raise UserError("a curve needs at least 2 frames")
    return Episode(frames, task="from arrays")


def _as_specs(goal: GoalLike, episode: Episode) -> list[GoalSpec]:
    """What a script gives as a goal, as the forms of rewards/goals.py."""
    if isinstance(goal, np.ndarray):
        check_pictures("the goal", goal, ndim=(3,))
        return [PictureArray(goal)]
    if isinstance(goal, Mapping):
        return _array_specs(goal, episode)
    if isinstance(goal, int):
        if goal < 0:
            raise UserError(f"goal {goal} is no frame: count from 0, or give 'last'")
        return [FrameNumber(goal)]
    known = goal.strip() == "last" or goal.strip().startswith(_FORMS)
    return [parse_goal(goal) if known else Sentence(goal)]


def _array_specs(goal: Mapping[str, np.ndarray], episode: Episode) -> list[GoalSpec]:
    for name, picture in goal.items():
        if name != "image" and name not in _SIDES:
            raise UserError(f"a goal has no '{name}': give image, left, right or several of them")
        check_pictures(f"the goal's {name}", picture, ndim=(3,))
    touch = {_SIDES[name]: picture for name, picture in goal.items() if name in _SIDES}
    sides = {key for key in TACTILE if key in episode.frames}
    if touch and touch.keys() != sides:
        raise UserError("the goal's fingertips must be the trajectory's: left, right or both")
    specs: list[GoalSpec] = [PictureArray(goal["image"])] if "image" in goal else []
    if touch:
        untouched = {key: touch_background(episode.frames[key]) for key in touch}
        specs.append(TouchArrays(touch, untouched))
    return specs


def _touch_encoder(encoder: str | Path | AnyTouchEncoder | None) -> AnyTouchEncoder:
    if isinstance(encoder, AnyTouchEncoder):
        return encoder
    return pretrained.load_encoder(pretrained.DEFAULT_ENCODER if encoder is None else encoder)
