"""Cost curves of one trajectory: a distance to the goal per frame and modality, and its rewards.

Names of curves: "image", "tactile" and "text" are single modalities (`rewards/goals.py`);
"image+tactile" and "image+text" are the fused ones, each the mean of two normalised curves. Raw
cosine distances are never averaged: the modality with the larger range would win.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from touchgoal.control.errors import UserError
from touchgoal.control.features import TACTILE, TRUTH_CONTACT
from touchgoal.episodes.metadata import write_file
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.touches import contact_per_frame
from touchgoal.rewards.metrics import CurveMetrics, measure_curve

FUSED = {"image+tactile": ("image", "tactile"), "image+text": ("image", "text")}

RewardForm = Literal["state", "difference"]


@dataclass(frozen=True)
class Contact:
    """When a fingertip first touches something.

    Attributes:
        frame: first frame in contact, None if there is none.
        known_from: "truth" (the simulator's), "detected" (from the tactile images), "no touch" (the
            source has no tactile images) or "not looked for" (a single tick).
    """

    frame: int | None
    known_from: Literal["truth", "detected", "no touch", "not looked for"]


@dataclass(frozen=True)
class Curves:
    """The curves of one trajectory to one goal.

    Attributes:
        source: which trajectory, for people: "data/pick#3" or "video.mp4".
        goal: the goal of each modality in the form a user writes.
        fps: frames per second.
        contact: first contact.
        raw: cosine distance 1 - cos in [0, 2] per frame, by modality.
        normalised: distance on the scale of the training episodes (1 their usual start, 0 their
            usual end; a frame may lie outside [0, 1]), by modality and fused; empty where no scale
            was given.
    """

    source: str
    goal: Mapping[str, str]
    fps: float
    contact: Contact
    raw: Mapping[str, Float[np.ndarray, " n"]]
    normalised: Mapping[str, Float[np.ndarray, " n"]]

    def __len__(self) -> int:
        """Number of frames."""
        return len(next(iter(self.raw.values())))

    @property
    def values(self) -> Mapping[str, Float[np.ndarray, " n"]]:
        """The curves to judge and to draw: normalised ones, raw ones where there is no scale."""
        return self.normalised or self.raw

    @property
    def unit(self) -> str:
        """What `values` are, as an axis label."""
        return "distance to goal (normalised)" if self.normalised else "cosine distance to goal"

    def metrics(self) -> dict[str, CurveMetrics]:
        """Metrics of each curve in `values`."""
        return {name: measure_curve(d, self.contact.frame) for name, d in self.values.items()}


def median_name(modality: str, own: bool) -> str:
    """Name of what a distance is scaled by: "image", or "own image" for a goal in the episode."""
    return f"own {modality}" if own else modality


@dataclass(frozen=True)
class DistanceNormalizer:
    """Where successful training episodes start and end, in raw cosine distance.

    n(d) = (d - goal) / (start - goal): 1 at the usual start, 0 at the usual end. There is one pair
    of medians for each `median_name`: a modality, with goals from elsewhere or from the own episode.

    Attributes:
        start: median raw distance of the start of a training episode to a goal.
        goal: the same for its end.
        separated: share of (episode, goal) pairs whose end is nearer the goal than its start.
        space: what made the embeddings, by modality.
        episodes: number of training episodes.
    """

    start: dict[str, float]
    goal: dict[str, float]
    separated: dict[str, float]
    space: dict[str, str]
    episodes: int

    def normalise(
        self,
        raw: Mapping[str, Float[np.ndarray, " n"]],
        space: Mapping[str, str],
        own: frozenset[str],
    ) -> dict[str, Float[np.ndarray, " n"]]:
        """Raw distances by modality -> normalised ones.

        Args:
            raw: distances by modality.
            space: what made the embeddings, by modality.
            own: modalities whose goal is a frame of the measured episode itself.

        Raises:
            UserError: a modality that was not fitted, or was fitted for other encoders.
        """
        normalised = {}
        for m, d in raw.items():
            name = median_name(m, m in own)
            if name not in self.start:
                raise UserError(f"the scale has no '{name}', only {list(self.start)}; fit it again")
            if self.space[m] != space[m]:
                raise UserError(
                    f"the scale of '{m}' was fitted for {self.space[m]}, these curves come from "
                    f"{space[m]}; fit it again with these encoders and this camera"
                )
            normalised[m] = (d - self.goal[name]) / (self.start[name] - self.goal[name])
        return normalised

    def save(self, path: Path) -> None:
        """Write JSON, atomically."""
        write_file(path, (json.dumps(asdict(self), indent=2) + "\n").encode())

    @classmethod
    def load(cls, path: Path) -> "DistanceNormalizer":
        """Read what `save` wrote.

        Raises:
            UserError: no such file, or not a scale.
        """
        if not path.is_file():
            raise UserError(f"there is no scale at {path}; fit one on successful episodes")
        try:
            content = json.loads(path.read_text())
        except json.JSONDecodeError:
            content = None
        if not isinstance(content, dict) or content.keys() != {f.name for f in fields(cls)}:
            raise UserError(f"{path} is not a scale; fit one on successful episodes")
        return cls(**content)


def add_fused_curves(
    normalised: Mapping[str, Float[np.ndarray, " n"]],
) -> dict[str, Float[np.ndarray, " n"]]:
    """Normalised single curves and, for each pair of `FUSED` that is there, their mean."""
    fused = {
        name: (normalised[a] + normalised[b]) / 2
        for name, (a, b) in FUSED.items()
        if a in normalised and b in normalised
    }
    return dict(normalised) | fused


def reward(d: Float[np.ndarray, " n"], form: RewardForm) -> Float[np.ndarray, " n"]:
    """Reward per frame from a cost curve.

    Args:
        d: distance to the goal per frame.
        form: "state": r_t = -d_t, so every frame away from the goal costs; this form can be
            compared with other rewards by EPIC. "difference":
            r_t = d_{t-1} - d_t with r_0 = 0, a reward for coming nearer (VIP, LIV); it sums to
            d_0 - d_T over any path, so detours earn nothing and standing still costs nothing. It
            is a shaping potential: added to an undiscounted task reward it leaves the best policy
            unchanged, and EPIC, which removes potentials, sees nothing in it.
    """
    if form == "state":
        return -d
    return np.concatenate([np.zeros(1, d.dtype), d[:-1] - d[1:]])


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
