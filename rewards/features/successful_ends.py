"""Ends of successful episodes as a goal that can be saved; the nearest one counts most."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Bool

from touchgoal.rewards.curves import Contact
from touchgoal.rewards.distance.normalizer import EmbeddingSource
from touchgoal.rewards.features.contact_reading import ContactReadings
from touchgoal.rewards.features.embedded import CameraFeatures, EmbeddedEpisode
from touchgoal.runtime.atomic_write import atomic_write
from touchgoal.runtime.errors import UserError

GOAL_FILE = "goal.npz"
_EQUAL = 1e-4  # largest difference between embeddings of the same frame in other batches
_REMEDY = "write one with touchgoal fit-normalizer"


@dataclass(frozen=True, eq=False)
class SuccessfulEnds:
    """Embedded last frames of successful episodes."""

    frames: EmbeddedEpisode  # one per episode
    objects: tuple[str, ...]  # object of each; "" if unknown

    @classmethod
    def of(cls, episodes: Sequence[EmbeddedEpisode]) -> "SuccessfulEnds":
        """Take the last frame of each of some episodes that were embedded alike."""
        ends = [episode.take(slice(len(episode) - 1, None)) for episode in episodes]
        return cls(ends[0].extended(ends[1:]), tuple(episode.object for episode in episodes))

    def for_trajectory(self, own: EmbeddedEpisode, what: str) -> EmbeddedEpisode:
        """Return the ends with the trajectory's object, all if objects are unknown here or there.

        The trajectory's own end is left out: it would cost 0 whatever happened. UserError, which names
        the goal as `what`: no end is left.
        """
        known = sorted(set(self.objects) - {""})
        fits = np.ones(len(self.objects), bool)
        if own.object and known:
            fits = np.array([one == own.object for one in self.objects])
            if not fits.any():
                raise UserError(
                    f"goal '{what}' has no end with {own.object}, only with {', '.join(known)}: add "
                    "a success with it"
                )
        rows = np.flatnonzero(fits & ~self._ends_of(own))
        if not len(rows):
            raise UserError(f"goal '{what}' holds the end of {own.source} alone: add a success")
        return self.frames.take(rows)

    def _ends_of(self, own: EmbeddedEpisode) -> Bool[np.ndarray, " ends"]:
        """Return which ends are the last frame of a trajectory."""
        pairs = []
        if own.image is not None and self.frames.image is not None:
            pairs.append((self.frames.image, own.image[-1]))
        if own.touch is not None and self.frames.touch is not None:
            pairs += list(zip(self.frames.touch, own.touch[:, -1], strict=True))
        return np.all([np.abs(ends - last).max(1) < _EQUAL for ends, last in pairs], axis=0)

    def save(self, path: Path) -> None:
        """Write a compressed npz file, atomically."""
        frames = self.frames
        arrays = {"image": frames.image, "touch": frames.touch, "wrench": frames.wrench}
        for key, camera in frames.cameras.items():
            arrays |= {f"pooled/{key}": camera.pooled, f"map/{key}": camera.map}
        if frames.readings is not None:
            arrays |= vars(frames.readings)
        about = {
            "objects": self.objects,
            "sides": frames.sides,
            "words": frames.words,
            "made_with": asdict(frames.made_with),
        }
        with atomic_write(path) as file, file.open("wb") as stream:
            present = {key: array for key, array in arrays.items() if array is not None}
            present["about"] = np.array(json.dumps(about))
            np.savez_compressed(stream, **present)  # pyright: ignore[reportArgumentType]

    @classmethod
    def load(cls, path: Path) -> "SuccessfulEnds":
        """Read a file that `save` wrote; UserError: no such file, or another one."""
        if not path.is_file():
            raise UserError(f"there is no goal file {path}: {_REMEDY}")
        try:
            with np.load(path, allow_pickle=False) as stored:
                arrays = dict(stored)
            about = json.loads(str(arrays["about"]))
            frames = _frames(arrays, about, path.name)
            return cls(frames, tuple(about["objects"]))
        except (OSError, ValueError, KeyError, TypeError, BadZipFile) as error:
            raise UserError(f"{path} is no goal file: {_REMEDY}") from error


def _frames(
    arrays: Mapping[str, np.ndarray], about: Mapping[str, object], name: str
) -> EmbeddedEpisode:
    keys = [key.removeprefix("pooled/") for key in arrays if key.startswith("pooled/")]
    readings = None
    if "touching" in arrays:
        names = [field.name for field in fields(ContactReadings) if field.name in arrays]
        readings = ContactReadings(**{name: arrays[name] for name in names})
    return EmbeddedEpisode(
        source=name,
        fps=1.0,
        contact=Contact(None, "not looked for"),
        made_with=EmbeddingSource(**about["made_with"]),  # pyright: ignore[reportCallIssue]
        image=arrays.get("image"),
        sides=tuple(about["sides"]),  # pyright: ignore[reportArgumentType]
        touch=arrays.get("touch"),
        words=bool(about["words"]),
        cameras={k: CameraFeatures(arrays[f"pooled/{k}"], arrays.get(f"map/{k}")) for k in keys},
        readings=readings,
        wrench=arrays.get("wrench"),
    )
