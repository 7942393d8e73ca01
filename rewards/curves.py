"""Cost and reward curves of one trajectory: per frame and part, a distance to the goal.

The parts (`distance.parts`) and their fusion, "fused", lie in [0, 1]. Beside them stand the plain
embedding distances of the modalities, "image", "tactile" and "text"; "image+tactile" and
"image+text" are means of two. The value of frame t depends only on frames up to t, but for the
background of a fingertip (the median of the first 5 frames) and a goal that is a frame of the
trajectory itself (`Curves.same_episode`).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Bool, Float

from touchgoal.control.features import TACTILE, TRUTH_CONTACT
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.touches import ContactStream
from touchgoal.rewards.metrics import CurveMetrics, measure_curve

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FUSED = {"image+tactile": ("image", "tactile"), "image+text": ("image", "text")}

PLAIN = frozenset({"image", "tactile", "text", *FUSED})
"""Plain distances of embeddings and their means, which stand beside the parts for comparison."""

GAMMA = 1.0
"""Default discount per second of the potential-based reward: standing still pays nothing."""
UNITS_AT_HALF = 1.5
"""Distance, in spreads of successful ends, at which a part costs 0.5; see `distance.parts`."""


@dataclass(frozen=True)
class Contact:
    """First contact of a fingertip.

    Attributes:
        frame: first frame in contact; None without contact.
        label_source: "truth" (the simulator's), "detected" (from the tactile images), "no touch" (the
            source has no tactile images) or "not looked for" (a single tick).
    """

    frame: int | None
    label_source: Literal["truth", "detected", "no touch", "not looked for"]


@dataclass(frozen=True, repr=False)
class Curves:
    """The curves of one trajectory to one goal.

    Attributes:
        source: name of the trajectory, for people: "data/pick#3" or "video.mp4".
        goal: the goal of each modality in the form that a user writes.
        fps: frames per second.
        contact: first contact.
        raw: cosine distance 1 - cos in [0, 2] per frame, by modality; touches shorter than 1 are
            completed to that (see `complete`) unless a normalizer follows.
        normalised: distance in units of the normalizer (1 the usual start, 0 the usual end, below
            0 nearer than that), by modality; empty without one.
        parts: smoothed cost of each part and "fused" per frame, in [0, 1]; empty without a
            normalizer.
        same_episode: modalities whose goal is a frame of this trajectory itself.
        note: which normalizer was used, or why there is none, for people.
    """

    source: str
    goal: Mapping[str, str]
    fps: float
    contact: Contact
    raw: Mapping[str, Float[np.ndarray, " n"]]
    normalised: Mapping[str, Float[np.ndarray, " n"]]
    parts: Mapping[str, Float[np.ndarray, " n"]] = field(default_factory=dict)
    same_episode: frozenset[str] = frozenset()
    note: str = ""

    def __len__(self) -> int:
        return len(next(iter(self.raw.values())))

    def __repr__(self) -> str:
        costs = ", ".join(f"{name} {c[0]:.2f} to {c[-1]:.2f}" for name, c in self.costs.items())
        note = f" ({self.note})" if self.note else ""
        return f"<Curves of {self.source}, {len(self)} frames, {self.unit}: {costs}{note}>"

    @property
    def costs(self) -> dict[str, Float[np.ndarray, " n"]]:
        """Costs by name of the curve: parts and normalised distances; raw without a normalizer.

        A normalised distance is below 0 where nearer to the goal than the usual end.
        """
        if not self.normalised:
            return {name: np.maximum(d, 0) for name, d in self.raw.items()}  # rounding: -1e-7
        return {**self.parts, **add_fused_curves(self.normalised)}

    @property
    def rewards(self) -> dict[str, Float[np.ndarray, " n"]]:
        """State reward -cost per frame, by name of the curve."""
        return {name: state_reward(d) for name, d in self.costs.items()}

    def potential_rewards(self, gamma: float = GAMMA) -> dict[str, Float[np.ndarray, " n"]]:
        """Return the potential-based reward of the step into each frame, by name of the curve.

        `gamma` is the discount per second: g^fps for an algorithm that discounts by g per frame.
        """
        step = gamma ** (1 / self.fps)
        return {name: potential_reward(d, step) for name, d in self.costs.items()}

    @property
    def unit(self) -> str:
        """Axis label of `costs`."""
        return "distance to goal (normalised)" if self.normalised else "cosine distance to goal"

    def metrics(self) -> dict[str, CurveMetrics]:
        """Return the metrics of each cost curve."""
        return {name: measure_curve(d, self.contact.frame) for name, d in self.costs.items()}

    def plot(self, gamma: float = GAMMA) -> "Figure":
        """Return a figure of costs and rewards over time; `.savefig("curves.png")` writes it."""
        from touchgoal.rewards.report.plot import draw

        return draw(self, gamma)  # pyright: ignore[reportArgumentType]  # one class by two paths


def add_fused_curves(
    single: Mapping[str, Float[np.ndarray, " n"]],
) -> dict[str, Float[np.ndarray, " n"]]:
    """Return the normalised single curves, and the mean of each pair of `FUSED` among them."""
    fused = {
        name: (single[a] + single[b]) / 2
        for name, (a, b) in FUSED.items()
        if a in single and b in single
    }
    return dict(single) | fused


def main_curve(names: Iterable[str]) -> str:
    """Return the curve that stands for all: a fused one if there is one, else the first."""
    listed = list(names)
    fused = [name for name in listed if name == "fused" or "+" in name]
    return (fused or listed)[0]


def reference_levels(names: Iterable[str], normalised: bool) -> list[tuple[float, str]]:
    """Return reference levels of a cost axis with their labels; none for raw distances."""
    if "fused" in names:
        return [(0.0, "goal"), (1 / (1 + UNITS_AT_HALF**2), "spread of successes"), (1.0, "far")]
    return [(0.0, "usual end"), (1.0, "usual start")] if normalised else []


def state_reward(cost: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return r_t = -cost_t."""
    return 0.0 - cost  # no negative zeros in the files


def potential_reward(cost: Float[np.ndarray, " n"], gamma: float) -> Float[np.ndarray, " n"]:
    """Return F_t = gamma Phi_t - Phi_{t-1} with Phi = -cost, F_0 = 0 (Ng et al. 1999, equation 2).

    `gamma` is the discount per step. With gamma = 1 it sums to cost_0 - cost_T over any path.
    With a smaller gamma, standing still earns (1 - gamma) cost per step: more, farther from the goal.
    """
    potential = state_reward(cost)
    return np.concatenate([np.zeros(1), gamma * potential[1:] - potential[:-1]])


class ContactSearch:
    """Search for the first contact over consecutive chunks of an episode.

    It takes the simulator's truth, else detects contact in the tactile images by comparing with the
    first frames, which must be free of contact.
    """

    def __init__(self) -> None:
        self.contact = Contact(None, "no touch")
        self._streams: dict[str, ContactStream] = {}
        self._frames = 0

    def update(self, chunk: Episode) -> Contact:
        """Search the next frames, at first at least 5; return the first contact so far."""
        truth = chunk.frames.get(TRUTH_CONTACT)
        sides = [key for key in TACTILE if key in chunk.frames]
        if self.contact.frame is None and (truth is not None or sides):
            touching = truth if truth is not None else self._detect(chunk, sides)
            frames = np.flatnonzero(touching.any(axis=1))
            first = self._frames + int(frames[0]) if len(frames) else None
            self.contact = Contact(first, "detected" if truth is None else "truth")
        self._frames += len(chunk)
        return self.contact

    def _detect(self, chunk: Episode, sides: list[str]) -> Bool[np.ndarray, "n sides"]:
        streams = [self._streams.setdefault(key, ContactStream()) for key in sides]
        pairs = zip(streams, sides, strict=True)
        return np.stack([stream.update(chunk.frames[key]) for stream, key in pairs], axis=1)
