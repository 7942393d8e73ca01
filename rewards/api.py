"""Reward curves from arrays, in one call."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from touchgoal.control.features import CONTROL_HZ, FRONT, TACTILE, TACTILE_LEFT, TACTILE_RIGHT
from touchgoal.encoders.preprocess import check_images
from touchgoal.encoders.pretrained import AnyTouchEncoder, shipped_encoder_for
from touchgoal.encoders.towers.towers import Towers
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.touches import touch_background
from touchgoal.rewards.curves import Curves
from touchgoal.rewards.distance.normalizer import DistanceNormalizer
from touchgoal.rewards.goals import (
    GoalPicture,
    GoalSpec,
    Inputs,
    OwnFrame,
    Sentence,
    TouchArrays,
    parse_goal,
)
from touchgoal.rewards.reward_model import load_reward_model
from touchgoal.runtime.errors import UserError

GoalLike = str | int | np.ndarray | Mapping[str, np.ndarray]
"""A goal in a script; see `reward_curve`."""

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
    device: str = "cpu",
) -> Curves:
    """Return costs and rewards of a trajectory, frame by frame, in each modality.

        curves = reward_curve(images, {"left": left, "right": right}, goal=("last", "a hard ball"))
        curves.costs["tactile"]  # (T,): distance to the goal
        curves.rewards["image"]  # (T,): -cost
        curves.potential_rewards()["text"]  # (T,): Phi' - Phi with Phi = -cost
        curves.plot().savefig("curves.png")

    Args:
        images: camera images, uint8 (T, height, width, 3), RGB.
        tactile: images of the fingertip sensors, "left", "right" or both, each as `images`. The
            first 5 must be free of contact: they are the background.
        goal: one, or several of which each modality takes the first that applies to it:
            "last" or a frame number, for the same frame of this trajectory (image and touch);
            an array (height, width, 3), a camera image;
            arrays by name, {"image": ..., "left": ..., "right": ...}, each (height, width, 3),
            of the goal state (touch with the same fingertips and the same background);
            a sentence on how the object feels (touch; or images, with the towers of a CLIP and
            without tactile); or any form of `reward-curves --goal`, such as "episode:data/set#3".
        encoder: touch encoder: a name ("gelsight_mini"), a folder, or one already loaded; a
            sentence as goal needs one that is aligned with texts. Default: the one that ships for
            the GelSight Mini.
        towers: "offline", a CLIP's Hugging Face id or folder, or loaded ones. Default: those that
            the encoder was trained with, "offline" without tactile.
        normalizer: what normalises the distances, so that 1 is the usual start and 0 the usual end:
            a file that `touchgoal fit-normalizer` wrote, one already read, or "encoder": the one
            that ships with the encoder, which holds for simulated pick-and-place alone and is what
            `touchgoal reward-curves` takes for such episodes. Default: raw cosine distances,
            because arrays do not say where they were recorded.
        camera: key of the camera, which the normalizer must have been fitted on.
        fps: frames per second.
        device: torch device of the encoders.

    Returns:
        `costs`, `rewards` and `potential_rewards(gamma)` by modality, each (T,), `metrics()` and
        `plot()`; `unit` and `note` say whether they are normalised.

    Raises:
        UserError: arrays that are not such images or do not match, a goal that no modality takes.
    """
    episode = _as_episode(images, tactile, camera)
    inputs = Inputs(
        name="this trajectory",
        camera=camera if camera in episode.frames else None,
        sides=tuple(key for key in TACTILE if key in episode.frames),
        length=len(episode),
    )
    goals = list(goal) if isinstance(goal, list | tuple) else [goal]
    specs = [spec for one in goals for spec in _as_specs(one, episode)]
    if encoder is None and inputs.sides:
        encoder = shipped_encoder_for("gelsight_mini")
    model = load_reward_model(inputs, specs, encoder, towers, normalizer, device)
    return model.curves(model.embedder.embed_episode(episode, fps, inputs.name))


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
        check_images(names[key], pictures, ndim=(4,))
    lengths = {names[key]: len(pictures) for key, pictures in frames.items()}
    if len(set(lengths.values())) > 1:
        counts = ", ".join(f"{name} {n}" for name, n in lengths.items())
        raise UserError(f"images and tactile must have equally many frames, not {counts}")
    if min(lengths.values()) < 2:
        raise UserError("a curve needs at least 2 frames")
    return Episode(frames, task="from arrays")


def _as_specs(goal: GoalLike, episode: Episode) -> list[GoalSpec]:
    """Return a script's goal in the forms of rewards/goals.py."""
    if isinstance(goal, np.ndarray):
        check_images("the goal", goal, ndim=(3,))
        return [GoalPicture(goal)]
    if isinstance(goal, Mapping):
        return _array_specs(goal, episode)
    if isinstance(goal, int):
        if goal < 0:
            raise UserError(f"goal {goal} is not a frame: count from 0, or give 'last'")
        return [OwnFrame(goal)]
    known = goal.strip() == "last" or goal.strip().startswith(_FORMS)
    return [parse_goal(goal) if known else Sentence(goal)]


def _array_specs(goal: Mapping[str, np.ndarray], episode: Episode) -> list[GoalSpec]:
    for name, picture in goal.items():
        if name != "image" and name not in _SIDES:
            raise UserError(f"a goal has no '{name}': give image, left, right or several of them")
        check_images(f"the goal's {name}", picture, ndim=(3,))
    touch = {_SIDES[name]: picture for name, picture in goal.items() if name in _SIDES}
    sides = {key for key in TACTILE if key in episode.frames}
    if touch and touch.keys() != sides:
        raise UserError("the goal's fingertips must be the trajectory's: left, right or both")
    specs: list[GoalSpec] = [GoalPicture(goal["image"])] if "image" in goal else []
    if touch:
        untouched = {key: touch_background(episode.frames[key]) for key in touch}
        specs.append(TouchArrays(touch, untouched))
    return specs
