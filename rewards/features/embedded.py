"""Embedded trajectories and goals: everything that a distance is computed from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float16, Float32

from touchgoal.rewards.curves import Contact
from touchgoal.rewards.distance.normalizer import EmbeddingSource
from touchgoal.rewards.features.contact_reading import ContactReadings
from touchgoal.rewards.goals import Modality

Rows = slice | np.ndarray


@dataclass(frozen=True, eq=False)
class CameraFeatures:
    """Features of one camera's images, by one pass of the image tower."""

    pooled: Float32[np.ndarray, "n d"]  # unit vectors
    map: Float16[np.ndarray, "n c y x"] | None = None  # at stride 16; None from other towers

    def take(self, rows: Rows) -> "CameraFeatures":
        """Return the features of some frames."""
        return CameraFeatures(self.pooled[rows], None if self.map is None else self.map[rows])

    @staticmethod
    def join(pieces: "Sequence[CameraFeatures]") -> "CameraFeatures":
        """Return consecutive features of one camera as one."""
        maps = [p.map for p in pieces if p.map is not None]
        pooled = np.concatenate([p.pooled for p in pieces])
        return CameraFeatures(pooled, np.concatenate(maps) if maps else None)


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
    # unit embeddings of the sentences about its object; None without sentences, or not requested
    descriptions: Float32[np.ndarray, "m k"] | None = None
    object: str = ""  # catalogue id of the object, "" if unknown
    success: bool | None = None  # whether the episode reached its goal, None if unknown
    words: bool = True  # whether its touch embeddings can be compared with sentences
    # features of the parts of a cost, by key of the camera; empty and None if not requested
    cameras: Mapping[str, CameraFeatures] = field(default_factory=dict)
    readings: ContactReadings | None = None  # contact of the fingertips `sides`
    wrench: Float32[np.ndarray, "n 6"] | None = None  # external force N, torque Nm; base frame

    def __len__(self) -> int:
        return self.touches().shape[1] if self.image is None else len(self.image)

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """Modalities that can be measured."""
        image: tuple[Modality, ...] = () if self.image is None else ("image",)
        touch: tuple[Modality, ...] = () if self.touch is None else ("tactile",)
        return (*image, *touch, "text") if touch and self.words else (*image, *touch)

    def pictures(self) -> Float32[np.ndarray, "n d"]:
        """Return the image embeddings of a trajectory that has the modality image."""
        assert self.image is not None, f"{self.source} has no pictures"
        return self.image

    def touches(self) -> Float32[np.ndarray, "sides n k"]:
        """Return the touch embeddings of a trajectory that has the modality tactile."""
        assert self.touch is not None, f"{self.source} has no touch"
        return self.touch

    def take(self, rows: Rows) -> "EmbeddedEpisode":
        """Return the trajectory with some of its frames; its first contact stays as it was."""
        return replace(
            self,
            image=None if self.image is None else self.image[rows],
            touch=None if self.touch is None else self.touch[:, rows],
            cameras={key: camera.take(rows) for key, camera in self.cameras.items()},
            readings=None if self.readings is None else self.readings.take(rows),
            wrench=None if self.wrench is None else self.wrench[rows],
        )

    def extended(self, later: "Sequence[EmbeddedEpisode]") -> "EmbeddedEpisode":
        """Return this trajectory with consecutive later pieces of itself behind it."""
        pieces = (self, *later)
        readings = [p.readings for p in pieces if p.readings is not None]
        wrenches = [p.wrench for p in pieces if p.wrench is not None]
        return replace(
            self,
            image=None if self.image is None else np.concatenate([p.pictures() for p in pieces]),
            touch=None if self.touch is None else np.concatenate([p.touches() for p in pieces], 1),
            cameras={k: CameraFeatures.join([p.cameras[k] for p in pieces]) for k in self.cameras},
            readings=ContactReadings.join(readings) if readings else None,
            wrench=np.concatenate(wrenches) if wrenches else None,
        )


@dataclass(frozen=True)
class EmbeddedGoal:
    """Goals of a trajectory as features, one or several (g) for each modality that has any.

    The nearest of several counts most (`soft_minimum`).
    """

    forms: Mapping[str, str]  # the goals as a user writes them, by modality
    same_episode: frozenset[str]  # modalities whose goal is the trajectory's own frame
    image: Float32[np.ndarray, "g d"] | None = None
    touch: Float32[np.ndarray, "sides g k"] | None = None
    text: Float32[np.ndarray, "g k"] | None = None
    text_baseline: Float32[np.ndarray, "b k"] | None = None  # of the baseline sentence, if any
    cameras: Mapping[str, CameraFeatures] = field(default_factory=dict)
    readings: ContactReadings | None = None
    wrench: Float32[np.ndarray, "g 6"] | None = None

    def as_frames(self) -> EmbeddedEpisode:
        """Return the goals as the frames of an episode."""
        return EmbeddedEpisode(
            source="goals",
            fps=1.0,
            contact=Contact(None, "not looked for"),
            made_with=EmbeddingSource("", ""),
            image=self.image,
            touch=self.touch,
            cameras=self.cameras,
            readings=self.readings,
            wrench=self.wrench,
        )


def goal_at_every_frame(frames: EmbeddedEpisode) -> EmbeddedGoal:
    """Return an embedding's frames as goals of image and touch."""
    return EmbeddedGoal(
        forms={},
        same_episode=frozenset(),
        image=frames.image,
        touch=frames.touch,
        cameras=frames.cameras,
        readings=frames.readings,
        wrench=frames.wrench,
    )
