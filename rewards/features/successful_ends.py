"""Ends of successful episodes as a goal that can be saved; the nearest one counts most."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from touchgoal.rewards.distance.normalizer import EmbeddingSource
from touchgoal.rewards.features import embedded
from touchgoal.rewards.judging.end_state import carried_row, put_down
from touchgoal.rewards.metrics import START_FRAMES
from touchgoal.runtime.errors import UserError

GOAL_FILE = "goal.npz"
_EQUAL = 1e-4  # largest difference between embeddings of the same frame in other batches
_REMEDY = "write one with touchgoal fit-normalizer"


@dataclass(frozen=True, eq=False)
class SuccessfulEnds:
    """Embedded last frames of successful episodes."""

    features: embedded.Features  # one row per episode
    objects: tuple[str, ...]  # object of each; "" if unknown
    made_with: EmbeddingSource

    @classmethod
    def of(cls, episodes: Sequence[embedded.EmbeddedEpisode]) -> "SuccessfulEnds":
        """Take the end of each of some episodes that were embedded alike, whole or only their ends."""
        unread = {name for name in episodes[0].features if name.endswith("_map")} - {"wrist_map"}
        ends = {k: rows for k, rows in embedded.last_rows(episodes).items() if k not in unread}
        if len(episodes[0].features.get("held", ())) > START_FRAMES + 1:
            down = [put_down(e.features, e.fps) for e in episodes]
            ends[embedded.PUT_DOWN] = np.array([row is not None for row in down])
            if not ends["held"].all(1).any():  # all hands are empty: what they carried was before
                felt = [embedded.split_features(e.features)[1] for e in episodes]
                rows = map(carried_row, felt, down)
                carried = embedded.join_rows(
                    [embedded.take_rows(f, np.array([i])) for f, i in zip(felt, rows, strict=True)]
                )
                ends |= {v: carried[k] for k, v in embedded.CARRIED.items() if k in carried}
        return cls(ends, tuple(e.object for e in episodes), episodes[0].made_with)

    def for_trajectory(self, own: embedded.EmbeddedEpisode, what: str) -> embedded.Features:
        """Return the ends with the trajectory's object, all if objects are unknown here or there.

        The trajectory's own end is left out: it would cost 0 whatever happened. UserError, which names
        the goal as `what`: no end is left, or they were embedded otherwise.
        """
        if (reason := self.made_with.mismatch(own.made_with)) is not None:
            raise UserError(f"goal '{what}' does not fit {own.source}: {reason}")
        known = sorted(set(self.objects) - {""})
        fits = np.ones(len(self.objects), bool)
        if own.object and known:
            fits = np.array([one == own.object for one in self.objects])
            if not fits.any():
                raise UserError(
                    f"goal '{what}' has no end with {own.object}, only with {', '.join(known)}: add "
                    "a success with it"
                )
        others = ~self._ends_of(own)
        rows = np.flatnonzero(fits & others)
        if not len(rows):
            raise UserError(f"goal '{what}' holds the end of {own.source} alone: add a success")
        goal = dict(embedded.take_rows(self.features, rows))
        if "wrist_map" in goal:
            goal[embedded.SCENE_MAP] = self.features["wrist_map"][others]
        return goal

    def _ends_of(self, own: embedded.EmbeddedEpisode) -> Bool[np.ndarray, " ends"]:
        """Return which ends are the last frame of a trajectory."""
        equal = [
            np.abs(self.features[name] - own.features[name][-1]).max(axis=-1) < _EQUAL
            for name in (embedded.IMAGE, embedded.TOUCH)
            if name in self.features and name in own.features
        ]
        return np.all([one.reshape(len(one), -1).all(axis=1) for one in equal], axis=0)

    def save(self, path: Path) -> None:
        """Write an npz file, atomically."""
        about = {"objects": self.objects, "made_with": asdict(self.made_with)}
        embedded.save_features(path, self.features, about)

    @classmethod
    def load(cls, path: Path) -> "SuccessfulEnds":
        """Read a file that `save` wrote; UserError: no such file, or another one."""
        if not path.is_file():
            raise UserError(f"there is no goal file {path}: {_REMEDY}")
        try:
            features, about = embedded.load_features(path)
            return cls(features, tuple(about["objects"]), EmbeddingSource(**about["made_with"]))
        except (ValueError, KeyError, TypeError) as error:
            raise UserError(f"{path} is no goal file: {_REMEDY}") from error
