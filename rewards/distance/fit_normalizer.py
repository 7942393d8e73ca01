"""Fitting of a `DistanceNormalizer` on successful episodes, of any camera and any lab."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from touchgoal.rewards.distance.normalizer import DistanceNormalizer, median_name
from touchgoal.rewards.distance.parts import (
    SMALLEST_UNIT,
    SPREAD_QUANTILE,
    cosine_distances,
    part_distances,
    touch_distances,
)
from touchgoal.rewards.features.embedded import IMAGE, TOUCH, EmbeddedEpisode, last_rows
from touchgoal.rewards.goals import Modality
from touchgoal.rewards.metrics import START_FRAMES
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.provenance import command_line, portable

END_FRAMES = 5  # frames before the last one that stand for the end of a training episode

MIN_SEPARATED = 0.75
"""Least share of (episode, goal) pairs whose end must be nearer the goal than its start; 0.5 is
chance. Below it, one unit of the normalised distance would mostly be noise."""

MIN_GAP = 1e-4
"""Least raw distance between the start and the goal median; float32 resolves about 1e-6."""


def separating(episodes: Sequence[EmbeddedEpisode]) -> tuple[list[Modality], list[str]]:
    """Return which of image and touch separate start from end, and why the others do not.

    Touch does not where the hand has let go at the end. UserError: as for `fit_normalizer`, or none does.
    """
    found: list[Modality] = []
    errors = []
    for modality in episodes[0].modalities:
        if modality == "text":
            continue
        try:
            fit_normalizer(episodes, [modality], "")
            found.append(modality)
        except UserError as error:
            errors.append(str(error))
    if not found:
        raise UserError(errors[0])
    return found, errors


def fit_normalizer(
    episodes: Sequence[EmbeddedEpisode], modalities: Sequence[Modality], scene: str
) -> DistanceNormalizer:
    """Fit on successful training episodes.

    Two kinds of goal have medians of their own, because an episode's own end is much nearer than
    another's: its own last frame; and for image the last frame of every other episode, for tactile
    that of every other episode with the same object, for text every sentence about its object. The
    5 frames before the last stand for the end (the last one is at distance 0 of itself), the first
    5 for the start. UserError: too few episodes, a failed or too short one, one embedded otherwise,
    or a modality that is missing or does not separate start from end.

    Args:
        episodes: at least two that end in the goal state, embedded alike.
        scene: where they were recorded, see `scene_of`.
    """
    _check_training(episodes, modalities)
    start, goal, separated = {}, {}, {}
    for modality in modalities:
        for same_episode in (False, True) if modality != "text" else (False,):
            starts, ends = _training_distances(episodes, modality, same_episode)
            name = median_name(modality, same_episode)
            if not len(starts):
                raise UserError(
                    f"no two training episodes can be compared in '{name}' (for touch they must "
                    "share an object): give more, or leave it out of --modalities"
                )
            share = separated[name] = float(np.mean(ends < starts))
            first, last = start[name], goal[name] = float(np.median(starts)), float(np.median(ends))
            if share < MIN_SEPARATED or first - last < MIN_GAP:
                raise UserError(
                    f"the training episodes do not separate start from end in '{name}': the end is "
                    f"nearer the goal in {share:.0%} of {len(starts)} pairs (needed "
                    f"{MIN_SEPARATED:.0%}), median distance {first:.4f} at the start and {last:.4f} "
                    "at the end; leave it out of --modalities, or take episodes that end in the "
                    "goal state"
                )
    about = episodes[0].made_with, scene, len(episodes), portable(command_line())
    return DistanceNormalizer(start, goal, fit_units(episodes), separated, *about)


def fit_units(episodes: Sequence[EmbeddedEpisode]) -> dict[str, float]:
    """Return the unit of each part: the 90 % quantile of its distance between two successful ends.

    Ends with the same object are compared, and the mean over the objects is taken: one that is held
    a little differently each time does not set the unit of all. Empty if no two share an object.
    """
    by_object: dict[str, list[EmbeddedEpisode]] = {}
    for episode in episodes:
        by_object.setdefault(episode.object, []).append(episode)
    spreads: dict[str, list[float]] = {}
    for group in by_object.values():
        if len(group) < 2:
            continue
        ends, others = last_rows(group), ~np.eye(len(group), dtype=bool)
        for name, d in part_distances(ends, ends).items():
            spreads.setdefault(name, []).append(float(np.quantile(d[others], SPREAD_QUANTILE)))
    return {
        name: max(float(np.mean(spread)), SMALLEST_UNIT.get(name, SMALLEST_UNIT["front"]))
        for name, spread in spreads.items()
    }


def _check_training(episodes: Sequence[EmbeddedEpisode], modalities: Sequence[Modality]) -> None:
    for e in episodes:
        if missing := [m for m in modalities if m not in e.modalities]:
            raise UserError(
                f"{e.source} has nothing for {' and '.join(missing)}: leave it out of --modalities"
            )
        if e.success is False:
            raise UserError(f"{e.source} failed; fit a normalizer on successful episodes alone")
        if len(e) < START_FRAMES + END_FRAMES + 1:
            raise UserError(
                f"{e.source} has {len(e)} frames; a training episode needs at least "
                f"{START_FRAMES + END_FRAMES + 1}"
            )
        if e.made_with != episodes[0].made_with or e.sides != episodes[0].sides:
            raise UserError(
                f"{e.source} was embedded by other encoders, or of another camera or fingertips, "
                f"than {episodes[0].source}; embed all training episodes alike"
            )


def _training_distances(
    episodes: Sequence[EmbeddedEpisode], modality: Modality, same_episode: bool
) -> tuple[Float[np.ndarray, " pairs"], Float[np.ndarray, " pairs"]]:
    """Return raw distances of the start and of the end of each episode to each of its goals."""
    starts, ends = [], []
    for e in episodes:
        goals = [o for o in episodes if (o is e) == same_episode]
        if modality == "tactile":
            goals = [o for o in goals if o.object == e.object]
        if modality == "text":
            d = cosine_distances(e.features[TOUCH].mean(1, np.float64), e.descriptions)
        elif not goals:
            continue
        elif modality == "image":
            d = cosine_distances(e.features[IMAGE], last_rows(goals)[IMAGE])
        else:
            d = touch_distances(e.features[TOUCH], last_rows(goals)[TOUCH])
        starts.append(np.median(d[:START_FRAMES], axis=0))
        ends.append(np.median(d[-1 - END_FRAMES : -1], axis=0))
    return np.concatenate([[], *starts]), np.concatenate([[], *ends])
