"""What makes distances of different modalities comparable: where successful episodes start and end.

Raw cosine distances of a picture, a touch and a sentence have different ranges (a modality gap keeps
touch and text far apart even at the goal). A `DistanceNormalizer`, fitted once on successful
episodes (`rewards/fit_normalizer.py`), maps each to 1 at the usual start and 0 at the usual end.
Scaling each episode by its own extremes instead would turn the noise of an episode that never
touches anything into a perfect curve.

It holds for what it was fitted on alone: the same towers, camera, fingertip sensor and touch
encoder, and the same scene. In commands it is `--normalizer PATH`, a file `normalizer.json`.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float

from touchgoal.control.features import TRUTH_FAILURE, TRUTH_PROGRESS, TRUTH_START
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError

NORMALIZER = "normalizer.json"
"""The normalizer in an encoder's folder: of the episodes that the encoder was trained on."""
REMEDY = "fit one with touchgoal fit-normalizer, or give --normalizer none for raw distances"
REAL_SCENE = "recorded, not simulated"


@dataclass(frozen=True)
class EmbeddingSource:
    """What embeddings were made with and of; only those of equal sources can be compared.

    Attributes:
        towers: "offline", or the hash of a CLIP's weights.
        camera: vocabulary key of the camera; "" for a plain video, whose camera nobody knows.
        encoder: hash of the touch encoder's weights and preprocessor; "" without touch.
        sensor: name of the fingertip sensor; "" without touch.
    """

    towers: str
    camera: str
    encoder: str = ""
    sensor: str = ""


def scene_of(features: Iterable[str]) -> str:
    """The simulated scene that episodes with these keys come from, or `REAL_SCENE`.

    Only the simulator records `truth.*`; each of its tasks has a key that the other lacks.
    """
    keys = set(features)
    if TRUTH_START in keys:
        return "simulated pick-place"
    if TRUTH_FAILURE in keys:
        return "simulated bead-maze"
    return "simulated" if TRUTH_PROGRESS in keys else REAL_SCENE


def median_name(modality: str, own: bool) -> str:
    """Name of a pair of medians: "image", or "own image" for goals from the episode itself."""
    return f"own {modality}" if own else modality


@dataclass(frozen=True)
class DistanceNormalizer:
    """Where successful training episodes start and end, in raw cosine distance.

    n(d) = (d - goal) / (start - goal): 1 at the usual start, 0 at the usual end, below 0 nearer than
    that. There is one pair of medians for each `median_name`: a modality, with goals from elsewhere
    or from the episode itself.

    Attributes:
        start: median raw distance of the start of a training episode to a goal.
        goal: the same for its end.
        separated: share of (episode, goal) pairs whose end is nearer the goal than its start.
        source: what the embeddings were made with.
        scene: see `scene_of`.
        episodes: number of training episodes.
    """

    start: dict[str, float]
    goal: dict[str, float]
    separated: dict[str, float]
    source: EmbeddingSource
    scene: str
    episodes: int

    def mismatch(
        self, source: EmbeddingSource, modalities: Iterable[str], own: frozenset[str]
    ) -> str | None:
        """Why such distances cannot be normalised by this; None if they can.

        A plain video is taken to come from the camera that the normalizer was fitted on: whoever
        names the normalizer says so.

        Args:
            source: what the embeddings are made with.
            modalities: those that have a goal.
            own: those whose goal is a frame of the measured episode itself.
        """
        mine, names = self.source, set(modalities)
        for m in sorted(names):
            if median_name(m, m in own) not in self.start:
                return f"it has no '{median_name(m, m in own)}', only {', '.join(self.start)}"
        pairs = []
        if "image" in names:
            pairs.append(("towers", mine.towers, source.towers))
            if source.camera:
                pairs.append(("camera", mine.camera, source.camera))
        if names & {"tactile", "text"}:
            pairs.append(("sensor", mine.sensor, source.sensor))
            pairs.append(("touch encoder", mine.encoder, source.encoder))
        for what, fitted, measured in pairs:
            if fitted != measured:
                return f"it was fitted with the {what} {fitted or 'unknown'}, not {measured}"
        return None

    def normalise(
        self,
        raw: Mapping[str, Float[np.ndarray, " n"]],
        source: EmbeddingSource,
        own: frozenset[str],
    ) -> dict[str, Float[np.ndarray, " n"]]:
        """Raw distances by modality -> normalised ones.

        Args:
            raw: distances by modality.
            source: what the embeddings were made with.
            own: modalities whose goal is a frame of the measured episode itself.

        Raises:
            UserError: a modality that was not fitted, or was fitted for something else.
        """
        reason = self.mismatch(source, raw, own)
        if reason:
            raise UserError(f"this normalizer does not apply: {reason}; {REMEDY}")
        normalised = {}
        for m, d in raw.items():
            name = median_name(m, m in own)
            normalised[m] = (d - self.goal[name]) / (self.start[name] - self.goal[name])
        return normalised

    def save(self, path: Path) -> None:
        """Write JSON, atomically."""
        write_file(path, (json.dumps(asdict(self), indent=2) + "\n").encode())

    @classmethod
    def load(cls, path: Path) -> "DistanceNormalizer":
        """Read what `save` wrote.

        Raises:
            UserError: no such file, or not a normalizer.
        """
        if not path.is_file():
            raise UserError(
                f"there is no normalizer at {path}: make one with touchgoal fit-normalizer"
            )
        try:
            content = json.loads(path.read_text())
            if content.keys() != {f.name for f in fields(cls)}:
                raise ValueError
            return cls(**content | {"source": EmbeddingSource(**content["source"])})
        except (ValueError, RecursionError, AttributeError, TypeError):
            raise UserError(
                f"{path} is not a normalizer: make one with touchgoal fit-normalizer"
            ) from None
