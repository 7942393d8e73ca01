"""Embedded trajectories and goals: everything that a distance is computed from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from touchgoal.rewards.curves import Contact
from touchgoal.rewards.distance.normalizer import EmbeddingSource
from touchgoal.rewards.goals import Modality

TIME_AXIS = {"image": 0, "touch": 1}
"""Fields of `EmbeddedEpisode` with a value a frame -> the axis that counts the frames."""


@dataclass(frozen=True)
class EmbeddedEpisode:
    """One embedded trajectory; its distance to a goal is then a dot product per frame."""

    source: str  # name of the trajectory, for people
    fps: float  # frames per second
    contact: Contact  # first contact
    made_with: EmbeddingSource  # encoders and sensors; embeddings of others cannot be compared
    image: Float32[np.ndarray, "n d"] | None = None  # unit image embeddings; None without a camera
    sides: tuple[str, ...] = ()  # keys of the fingertips that have touch embeddings
    touch: Float32[np.ndarray, "sides n k"] | None = None  # unit embeddings; None without touch
    # unit embeddings of the sentences about its object; None if there are none or they were not
    # requested
    descriptions: Float32[np.ndarray, "m k"] | None = None
    object: str = ""  # catalogue id of the object, "" if unknown
    success: bool | None = None  # whether the episode reached its goal, None if unknown
    words: bool = True  # whether its touch embeddings can be compared with sentences

    def __len__(self) -> int:
        return self.touches().shape[1] if self.image is None else len(self.image)

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """Modalities that can be measured."""
        image: tuple[Modality, ...] = () if self.image is None else ("image",)
        touch: tuple[Modality, ...] = () if self.touch is None else ("tactile",)
        return (*image, *touch, "text") if touch and self.words else (*image, *touch)

    @classmethod
    def joined(cls, pieces: "Sequence[EmbeddedEpisode]", repeated: int) -> "EmbeddedEpisode":
        """Return consecutive pieces of one trajectory as one.

        The first `repeated` frames of every piece but the first were embedded for context only.
        """
        joined = {}
        for name, axis in TIME_AXIS.items():
            arrays = [getattr(piece, name) for piece in pieces]
            if arrays[0] is not None:
                later = [np.delete(a, np.s_[:repeated], axis) for a in arrays[1:]]
                joined[name] = np.concatenate([arrays[0], *later], axis)
        return replace(pieces[0], **joined)

    def pictures(self) -> Float32[np.ndarray, "n d"]:
        """Return the image embeddings of a trajectory that has the modality image."""
        assert self.image is not None, f"{self.source} has no pictures"
        return self.image

    def touches(self) -> Float32[np.ndarray, "sides n k"]:
        """Return the touch embeddings of a trajectory that has the modality tactile."""
        assert self.touch is not None, f"{self.source} has no touch"
        return self.touch


@dataclass(frozen=True)
class EmbeddedGoal:
    """A goal as unit embeddings, one per modality that has a goal."""

    forms: Mapping[str, str]  # the goals as a user writes them, by modality
    same_episode: frozenset[str]  # modalities whose goal is the trajectory's own frame
    image: Float32[np.ndarray, " d"] | None = None
    touch: Float32[np.ndarray, "sides k"] | None = None
    text: Float32[np.ndarray, " k"] | None = None
