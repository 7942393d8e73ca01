"""Cost and reward curves of one trajectory: per frame and part, a distance to the goal.

The parts (`distance.parts`) and their fusion, "fused", lie in [0, 1]. The plain embedding distances
of MMWand, "image", "tactile" and "text", are the same distances without units; "image+tactile" and
"image+text" are means of two. The value of frame t depends only on frames up to t, but for the
background of a fingertip (the median of the first 5 frames) and a goal that is a frame of the
trajectory itself (`Curves.same_episode`).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

from touchgoal.rewards.metrics import CurveMetrics, measure_curve

FUSED = "fused"
"""Name of the curve that stands for all parts."""
_MEANS = {"image+tactile": ("image", "tactile"), "image+text": ("image", "text")}
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
            completed to that (see `complete`) unless a normalizer follows. Of a force goal, the
            difference as a share of it.
        normalised: plain distance (1 the usual start, 0 the usual end, below 0 nearer than that),
            by modality; empty without a normalizer.
        parts: smoothed cost of each part and "fused" per frame, in [0, 1]; empty without units, or
            if plain distances were asked for.
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
    def costs(self) -> Mapping[str, Float[np.ndarray, " n"]]:
        """Costs by name of the curve: the parts, or without them the plain distances."""
        return self.parts or self.plain

    @property
    def plain(self) -> dict[str, Float[np.ndarray, " n"]]:
        """Plain distances by modality: normalised, with the means of two; else raw.

        A normalised distance is below 0 where nearer to the goal than the usual end.
        """
        single = self.normalised
        if not single:
            return {name: np.maximum(d, 0) for name, d in self.raw.items()}  # rounding: -1e-7
        pairs = {name: pair for name, pair in _MEANS.items() if single.keys() >= set(pair)}
        return {**single, **{name: (single[a] + single[b]) / 2 for name, (a, b) in pairs.items()}}

    @property
    def rewards(self) -> dict[str, Float[np.ndarray, " n"]]:
        """State reward -cost per frame, by name of the curve."""
        return {name: 0.0 - d for name, d in self.costs.items()}  # no negative zeros in the files

    def potential_rewards(self, gamma: float = GAMMA) -> dict[str, Float[np.ndarray, " n"]]:
        """Return the potential-based reward of the step into each frame, by name of the curve.

        `gamma` is the discount per second: g^fps for an algorithm that discounts by g per frame.
        """
        step = gamma ** (1 / self.fps)
        return {name: potential_reward(d, step) for name, d in self.costs.items()}

    @property
    def unit(self) -> str:
        """Axis label of `costs`."""
        if self.normalised:
            return "distance to goal (normalised)"
        alone = set(self.raw) == {"force"}
        return "share of the goal's force" if alone else "cosine distance to goal"

    def metrics(self) -> dict[str, CurveMetrics]:
        """Return the metrics of each cost curve."""
        return {name: measure_curve(d, self.contact.frame) for name, d in self.costs.items()}


def main_curve(names: Iterable[str]) -> str:
    """Return the curve that stands for all: a fused one if there is one, else the first."""
    listed = list(names)
    fused = [name for name in listed if name == FUSED or "+" in name]
    return (fused or listed)[0]


def main_first(names: Iterable[str]) -> list[str]:
    """Return each name once, the main curve first."""
    listed = list(dict.fromkeys(names))
    return sorted(listed, key=main_curve(listed).__ne__)


def reference_levels(names: Iterable[str], normalised: bool) -> list[tuple[float, str]]:
    """Return reference levels of a cost axis with their labels; none for raw distances."""
    if FUSED in names:
        return [(0.0, "goal"), (1 / (1 + UNITS_AT_HALF**2), "spread of successes"), (1.0, "far")]
    return [(0.0, "usual end"), (1.0, "usual start")] if normalised else []


def potential_reward(cost: Float[np.ndarray, " n"], gamma: float) -> Float[np.ndarray, " n"]:
    """Return F_t = gamma Phi_t - Phi_{t-1} with Phi = -cost, F_0 = 0 (Ng et al. 1999, equation 2).

    `gamma` is the discount per step. With gamma = 1 it sums to cost_0 - cost_T over any path.
    With a smaller gamma, standing still earns (1 - gamma) cost per step: more, farther from the goal.
    """
    return np.concatenate([np.zeros(1), cost[:-1] - gamma * cost[1:]])
