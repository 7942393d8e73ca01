"""Cost and reward curves of one trajectory: per frame and modality, a distance to the goal.

Names of curves: "image", "tactile" and "text" are single modalities (`rewards/goals.py`);
"image+tactile" and "image+text" are fused, each the mean of two normalised costs. Raw cosine
distances are never averaged: the modality with the larger range would win.

What a reader may rely on, for every curve:

- cost: small at the goal and never below 0. Normalised (`rewards/normalizer.py`), 1 is the usual
  start and 0 the usual end of successful episodes; a frame nearer than their usual end costs 0 too.
  Without a normalizer it is the cosine distance itself, between 0 and 2.
- state reward: -cost. At most 0, at the goal; about -1 at the usual start where it is normalised,
  -2 to 0 where it is not. Every frame away from the goal costs.
- potential-based reward of the step into frame t: F_t = gamma Phi_t - Phi_{t-1} with the state
  reward as potential Phi (Ng, Harada and Russell 1999): added to a task's own reward of the same
  gamma it leaves the best policy unchanged. Phi is 0 at the goal, as it must be where an episode
  ends. No step leads into the first frame: F_0 = 0.
- causal: the values of frame t depend on frames up to t alone. There are two exceptions, both said
  in the reports: the untouched fingertip is the median of the first 5 frames, so touch before the
  fifth looks ahead to it; and a goal taken from the episode itself is known at its end alone.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from touchgoal.control.features import TACTILE, TRUTH_CONTACT
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.touches import contact_per_frame
from touchgoal.rewards.metrics import CurveMetrics, measure_curve

FUSED = {"image+tactile": ("image", "tactile"), "image+text": ("image", "text")}

GAMMA = 0.99
"""Discount of the potential-based reward, where none is given."""


@dataclass(frozen=True)
class Contact:
    """When a fingertip first touches something.

    Attributes:
        frame: first frame in contact, None if there is none.
        label_source: "truth" (the simulator's), "detected" (from the tactile images), "no touch" (the
            source has no tactile images) or "not looked for" (a single tick).
    """

    frame: int | None
    label_source: Literal["truth", "detected", "no touch", "not looked for"]


@dataclass(frozen=True)
class Curves:
    """The curves of one trajectory to one goal.

    Attributes:
        source: which trajectory, for people: "data/pick#3" or "video.mp4".
        goal: the goal of each modality in the form a user writes.
        fps: frames per second.
        contact: first contact.
        raw: cosine distance 1 - cos in [0, 2] per frame, by modality.
        normalised: distance in units of the normalizer (1 the usual start, 0 the usual end, below
            0 nearer than that), by modality; empty without one.
        own_goal: modalities whose goal is a frame of this trajectory, known at its end alone.
    """

    source: str
    goal: Mapping[str, str]
    fps: float
    contact: Contact
    raw: Mapping[str, Float[np.ndarray, " n"]]
    normalised: Mapping[str, Float[np.ndarray, " n"]]
    own_goal: frozenset[str] = frozenset()

    def __len__(self) -> int:
        """Number of frames."""
        return len(next(iter(self.raw.values())))

    @property
    def costs(self) -> dict[str, Float[np.ndarray, " n"]]:
        """The curves to judge and to draw: normalised and fused; raw ones without a normalizer."""
        if not self.normalised:
            return {name: np.maximum(d, 0) for name, d in self.raw.items()}  # rounding: -1e-7
        return add_fused_curves({name: np.maximum(d, 0) for name, d in self.normalised.items()})

    @property
    def unclipped(self) -> dict[str, Float[np.ndarray, " n"]]:
        """The same, below 0 where nearer than the usual end: to rank what costs 0."""
        return add_fused_curves(self.normalised) if self.normalised else dict(self.raw)

    @property
    def rewards(self) -> dict[str, Float[np.ndarray, " n"]]:
        """State reward -cost per frame, of every cost curve."""
        return {name: state_reward(d) for name, d in self.costs.items()}

    def potential_rewards(self, gamma: float = GAMMA) -> dict[str, Float[np.ndarray, " n"]]:
        """Potential-based reward of the step into each frame, of every cost curve."""
        return {name: potential_reward(d, gamma) for name, d in self.costs.items()}

    @property
    def unit(self) -> str:
        """What `costs` are, as an axis label."""
        return "distance to goal (normalised)" if self.normalised else "cosine distance to goal"

    def metrics(self) -> dict[str, CurveMetrics]:
        """Metrics of each cost curve."""
        return {name: measure_curve(d, self.contact.frame) for name, d in self.costs.items()}


def add_fused_curves(
    single: Mapping[str, Float[np.ndarray, " n"]],
) -> dict[str, Float[np.ndarray, " n"]]:
    """Normalised single curves and, for each pair of `FUSED` that is there, their mean."""
    fused = {
        name: (single[a] + single[b]) / 2
        for name, (a, b) in FUSED.items()
        if a in single and b in single
    }
    return dict(single) | fused


def state_reward(cost: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """r_t = -cost_t: highest, 0, at the goal."""
    return 0.0 - cost  # no negative zeros in the files


def potential_reward(
    cost: Float[np.ndarray, " n"], gamma: float = GAMMA
) -> Float[np.ndarray, " n"]:
    """F_t = gamma Phi_t - Phi_{t-1} with Phi = -cost, and F_0 = 0 (Ng et al. 1999, equation 2).

    With gamma = 1 it sums to cost_0 - cost_T over any path: detours earn nothing.
    """
    potential = state_reward(cost)
    return np.concatenate([np.zeros(1), gamma * potential[1:] - potential[:-1]])


def first_contact(episode: Episode) -> Contact:
    """First frame in which a fingertip touches: the simulator's truth, else from the images.

    Detection compares with the first frames, which must be free of contact.
    """
    if TRUTH_CONTACT in episode.frames:
        return Contact(_first(episode.frames[TRUTH_CONTACT]), "truth")
    sides = [episode.frames[key] for key in TACTILE if key in episode.frames]
    if not sides:
        return Contact(None, "no touch")
    touching = [contact_per_frame(side) for side in sides]
    return Contact(_first(np.stack(touching, axis=1)), "detected")


def _first(touching: Bool[np.ndarray, "n sides"]) -> int | None:
    frames = np.flatnonzero(touching.any(axis=1))
    return int(frames[0]) if len(frames) else None
