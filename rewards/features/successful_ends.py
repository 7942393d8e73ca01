"""Ends of successful episodes, a goal that can be saved: of several the nearest counts."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from touchgoal.rewards.curves import Contact
from touchgoal.rewards.distance.normalizer import EmbeddingSource
from touchgoal.rewards.features.contact_reading import ContactReadings
from touchgoal.rewards.features.embedded import CameraFeatures, EmbeddedEpisode
from touchgoal.runtime.atomic_write import atomic_write
from touchgoal.runtime.errors import UserError

GOAL_FILE = "goal.npz"
_REMEDY = "write one with touchgoal fit-normalizer"


@dataclass(frozen=True, eq=False)
class SuccessfulEnds:
    """Embedded last frames of successful episodes."""

    frames: EmbeddedEpisode  # one frame an episode
    objects: tuple[str, ...]  # object of each; "" if unknown

    @classmethod
    def of(cls, episodes: Sequence[EmbeddedEpisode]) -> "SuccessfulEnds":
        """Take the last frame of each of some episodes that were embedded alike."""
        ends = [episode.take(slice(len(episode) - 1, None)) for episode in episodes]
        return cls(ends[0].extended(ends[1:]), tuple(episode.object for episode in episodes))

    def of_object(self, name: str, what: str) -> EmbeddedEpisode:
        """Return the ends with an object, all if objects are unknown here or there.

        UserError, which names the goal as `what`: the object is not among those known.
        """
        known = sorted(set(self.objects) - {""})
        if not name or not known:
            return self.frames
        rows = np.flatnonzero([one == name for one in self.objects])
        if not len(rows):
            raise UserError(
                f"goal '{what}' has no end with {name}, only with {', '.join(known)}: add a "
                "success with it"
            )
        return self.frames.take(rows)

    def save(self, path: Path) -> None:
        """Write a compressed npz file, atomically."""
        frames, arrays = self.frames, _Arrays()
        arrays.add("image", frames.image)
        arrays.add("touch", frames.touch)
        for key, camera in frames.cameras.items():
            arrays.add(f"pooled/{key}", camera.pooled)
            arrays.add(f"map/{key}", camera.map)
        if frames.readings is not None:
            for name in ("touching", "force", "centre"):
                arrays.add(name, getattr(frames.readings, name))
        about = {
            "objects": self.objects,
            "sides": frames.sides,
            "words": frames.words,
            "made_with": asdict(frames.made_with),
        }
        with atomic_write(path) as file, file.open("wb") as stream:
            np.savez_compressed(stream, about=np.array(json.dumps(about)), **arrays)

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


class _Arrays(dict[str, np.ndarray]):
    def add(self, name: str, array: np.ndarray | None) -> None:
        if array is not None:
            self[name] = array


def _frames(
    arrays: Mapping[str, np.ndarray], about: Mapping[str, object], name: str
) -> EmbeddedEpisode:
    keys = [key.removeprefix("pooled/") for key in arrays if key.startswith("pooled/")]
    readings = None
    if "touching" in arrays:
        readings = ContactReadings(arrays["touching"], arrays.get("force"), arrays.get("centre"))
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
    )
