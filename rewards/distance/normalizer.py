"""Normalizer that makes the distances of different modalities comparable.

It holds only for the towers, camera, fingertip sensor, touch encoder and scene that it was fitted
on. Scaling each episode by its own extremes would make a perfect curve of noise.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from touchgoal.control.features import TRUTH_FAILURE, TRUTH_PROGRESS, TRUTH_START
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.json_file import read_json, write_json

NORMALIZER = "normalizer.json"
"""Name of the file in an encoder's folder, fitted on the encoder's training episodes."""
REMEDY = "fit one with touchgoal fit-normalizer, or give --normalizer none for raw distances"
REAL_SCENE = "recorded, not simulated"


@dataclass(frozen=True)
class EmbeddingSource:
    """Encoders, camera and sensor of embeddings; only those of equal ones can be compared."""

    towers: str  # `steady_images.STEADY`, or the hash of a CLIP's weights
    camera: str  # key of the camera; "" for a plain video, whose camera is unknown
    encoder: str = ""  # hash of the touch encoder's weights and preprocessor; "" without touch
    sensor: str = ""  # name of the fingertip sensor; "" without touch

    def mismatch(
        self, other: "EmbeddingSource", images: bool = True, touch: bool = True
    ) -> str | None:
        """Return why embeddings of another source cannot be compared with these; None if they can.

        A plain video counts as taken by the camera here; what one of them lacks is not compared.
        """
        for what in ("towers", "camera") * images + ("sensor", "encoder") * touch:
            mine, theirs = getattr(self, what), getattr(other, what)
            if mine and theirs and mine != theirs:
                return f"its {what} is {mine}, not {theirs}"
        return None


def scene_of(features: Iterable[str]) -> str:
    """Return the simulated scene that episodes with these keys come from, or `REAL_SCENE`.

    Only the simulator records `truth.*`; each of its tasks has a key that the other lacks.
    """
    keys = set(features)
    if TRUTH_START in keys:
        return "simulated pick-place"
    if TRUTH_FAILURE in keys:
        return "simulated bead-maze"
    return "simulated" if TRUTH_PROGRESS in keys else REAL_SCENE


def median_name(modality: str, same_episode: bool) -> str:
    """Return the name of a pair of medians: "image", or "image (same episode)".

    The latter is for goals that are a frame of the measured episode itself.
    """
    return f"{modality} (same episode)" if same_episode else modality


@dataclass(frozen=True)
class DistanceNormalizer:
    """Raw cosine distances at which successful training episodes start and end; units of the parts.

    n(d) = (d - goal) / (start - goal): 1 at the usual start, 0 at the usual end, below 0 nearer than
    that. There is one pair of medians for each `median_name`. The unit of a part of the cost
    (`distance.parts`) is the spread of its distance among successful ends. A force
    goal needs neither: see `distance.cost`.
    """

    start: dict[str, float]  # median raw distance of the start of a training episode to a goal
    goal: dict[str, float]  # the same for its end
    unit: dict[str, float]  # unit of each part's distance; empty if no two share an object
    separated: dict[str, float]  # share of (episode, goal) pairs whose end is nearer than the start
    source: EmbeddingSource  # encoders, camera and sensor of the embeddings
    scene: str  # see `scene_of`
    episodes: int  # number of training episodes
    command: str = ""  # that fitted it

    def mismatch(
        self,
        source: EmbeddingSource,
        modalities: Iterable[str],
        same_episode: frozenset[str],
        without: Collection[str] = (),
    ) -> str | None:
        """Return why such distances cannot be normalised by this; None if they can.

        A plain video counts as taken by the camera that the normalizer was fitted on. The goal of a
        modality in `same_episode` is a frame of the measured episode itself. Those in `without` need no
        medians where parts have units: touch of a hand that lets go ends as it began.
        """
        names = set(modalities) - {"force"}
        for m in sorted(names - set(without if self.unit else ())):
            if (name := median_name(m, m in same_episode)) not in self.start:
                return f"it has no '{name}', only {', '.join(self.start)}"
        reason = self.source.mismatch(source, "image" in names, bool(names & {"tactile", "text"}))
        return reason and f"it was fitted with other embeddings: {reason}"

    def normalise(
        self,
        raw: Mapping[str, Float[np.ndarray, " n"]],
        source: EmbeddingSource,
        same_episode: frozenset[str],
        parts: bool = False,
    ) -> dict[str, Float[np.ndarray, " n"]]:
        """Return normalised distances by modality, from raw cosine distances; see `mismatch`.

        With `parts` a modality without medians is left out. UserError: one that was not fitted, or was
        fitted for something else.
        """
        reason = self.mismatch(source, raw, same_episode, ("image", "tactile") if parts else ())
        if reason:
            raise UserError(f"this normalizer does not apply: {reason}; {REMEDY}")
        normalised = {}
        for m, d in raw.items():
            name = median_name(m, m in same_episode)
            if m == "force":
                normalised[m] = d
            elif name in self.start:
                normalised[m] = (d - self.goal[name]) / (self.start[name] - self.goal[name])
        return normalised

    def save(self, path: Path) -> None:
        """Write JSON, atomically."""
        write_json(path, self)

    @classmethod
    def load(cls, path: Path) -> "DistanceNormalizer":
        """Read a file that `save` wrote; UserError: no such file, or another one."""
        otherwise = f"{path} is no normalizer: make one with touchgoal fit-normalizer"
        return read_json(path, cls, otherwise)
