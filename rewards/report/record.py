"""Record of one measured trajectory: all that reports are made from, in one file.

A measurement that goes on after an interruption reads it instead of measuring again, so that its reports
are those of an uninterrupted one.
"""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from touchgoal.rewards.curves import Curves
from touchgoal.rewards.features.embedded import load_features, save_features
from touchgoal.rewards.metrics import CurveMetrics, find_peaks
from touchgoal.rewards.report.thumbnails import Thumbnails
from touchgoal.rewards.sources.trajectory import Trajectory

COST, REWARD, POTENTIAL, RAW = "cost_", "reward_", "potential_reward_", "cosine_distance_"
"""Beginnings of the names of columns."""
_SHEET, _THUMB = "sheet/", "thumb"


@dataclass(frozen=True)
class Facts:
    """Everything about a measured trajectory but its values per frame and its images."""

    name: str  # file name of its reports
    source: str  # name for people
    index: int  # number within the source
    offset: int  # number of frames of the source before it
    frames: int
    fps: float  # frames per second
    unit: str  # axis label of the costs
    normalised: bool  # whether a cost of 1 is the usual start and 0 the usual end
    goal: dict[str, str]  # by modality, in the form that a user writes
    own_goal: bool  # whether a goal is a frame of the trajectory itself
    contact: int | None  # first frame in contact
    contact_source: str  # see Contact.label_source
    object: str  # "" if unknown
    outcome: str  # "success", a kind of failure, or "" if unknown
    success: bool | None  # None if unknown
    measured: dict[str, CurveMetrics]  # metrics of each cost curve
    peaks: dict[str, list[int]]  # frames of the bumps of each cost curve
    shown: list[int]  # frames that the images show
    columns: list[str]  # names of the values per frame
    # whether touch is near its goal before the first contact, and far from it later
    goal_untouched: bool = False


@dataclass(frozen=True, eq=False)
class Record:
    """A measured trajectory."""

    facts: Facts
    columns: dict[str, Float[np.ndarray, " n"]]  # values per frame
    sheets: dict[str, UInt8[np.ndarray, " bytes"]]  # JPEG of each camera and fingertip
    thumb: UInt8[np.ndarray, " thumb"]  # JPEG of the last frame

    @property
    def costs(self) -> dict[str, Float[np.ndarray, " n"]]:
        """Cost curves by name."""
        return {k.removeprefix(COST): v for k, v in self.columns.items() if k.startswith(COST)}

    def save(self, path: Path) -> None:
        """Write the record atomically."""
        sheets = {f"{_SHEET}{key}": sheet for key, sheet in self.sheets.items()}
        save_features(path, {**self.columns, **sheets, _THUMB: self.thumb}, asdict(self.facts))

    @classmethod
    def load(cls, path: Path) -> "Record":
        """Read a record that `save` wrote."""
        arrays, facts = load_features(path)
        columns, thumb = {k: arrays.pop(k) for k in facts["columns"]}, arrays.pop(_THUMB)
        sheets = {key.removeprefix(_SHEET): sheet for key, sheet in arrays.items()}
        facts["measured"] = {k: CurveMetrics(**values) for k, values in facts["measured"].items()}
        return cls(Facts(**facts), columns, sheets, thumb)


def record_of(curves: Curves, trajectory: Trajectory, thumbnails: Thumbnails) -> Record:
    """Return the record of a measured trajectory."""
    meta, metrics = trajectory.meta, curves.metrics()
    success = meta.get("success")
    columns, contact = columns_of(curves), curves.contact
    touch, first = curves.raw.get("tactile"), contact.frame
    facts = Facts(
        name=trajectory.name,
        source=curves.source,
        index=trajectory.index,
        offset=trajectory.offset,
        frames=len(curves),
        fps=float(curves.fps),
        unit=curves.unit,
        normalised=bool(curves.normalised),
        goal=dict(curves.goal),
        own_goal=bool(curves.same_episode),
        contact=contact.frame,
        contact_source=contact.label_source,
        object=str(meta.get("object", "")),
        outcome=str(meta.get("outcome") or {None: "", True: "success"}.get(success, "failure")),
        success=None if success is None else bool(success),
        measured=metrics,
        peaks={n: find_peaks(c, metrics[n].eps).tolist() for n, c in curves.costs.items()},
        shown=thumbnails.shown,
        columns=list(columns),
        goal_untouched=touch is not None
        and "tactile" in curves.goal
        and bool(first and np.median(touch[:first]) < touch[first:].max() / 2),
    )
    return Record(facts, columns, thumbnails.sheets(), thumbnails.last())


def columns_of(curves: Curves) -> dict[str, Float[np.ndarray, " n"]]:
    """Return all values per frame: costs, both forms of reward, raw distances."""
    groups = {
        COST: curves.costs,
        REWARD: curves.rewards,
        POTENTIAL: curves.potential_rewards(),
        RAW: {m: d for m, d in curves.raw.items() if m != "force"},  # no cosine
    }
    return {
        f"{kind}{name}": values.astype(np.float64)
        for kind, group in groups.items()
        for name, values in group.items()
    }
