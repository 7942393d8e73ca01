"""Grasps with a measured force: the layout of EstimateModulus (MIT, arXiv 2407.15304).

A folder holds `grasps.csv` (trial, object), and for each trial `TRIAL.avi` (a fingertip's raw images)
and `TRIAL.csv` (force_newtons, gripper_width_m; one row per frame).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from touchgoal.control.sensors.clip import read_frames
from touchgoal.control.sensors.tactile_camera import rectify
from touchgoal.control.tactile.sensor_models import GELSIGHT_WEDGE
from touchgoal.episodes.importers.labelled_videos import check_there, read_table
from touchgoal.runtime.option_types import Corners

_COLUMNS = ("force_newtons", "gripper_width_m")


@dataclass(frozen=True, eq=False)
class ForceGrasp:
    """One grasp, from the open hand and back."""

    trial: str  # name of the grasp
    object: str  # id of the object
    video: Path  # video file
    force: Float[np.ndarray, " n"]  # of each frame, N, as measured, with spikes and drift
    width: Float[np.ndarray, " n"]  # gripper width of each frame, m
    corners: Corners | None = None  # corners of the gel in the images, px; None: do not rectify

    def frames(self) -> UInt8[np.ndarray, "m h w 3"]:
        """Return as many RGB frames as `force` has: raw, or rectified to a GelSight Wedge's gel."""
        frames = read_frames(self.video)[0][: len(self.force)]
        if self.corners is None:
            return frames
        return np.stack([rectify(f, GELSIGHT_WEDGE.image_shape, self.corners) for f in frames])


def read_force_grasps(folder: Path, corners: Corners | None = None) -> list[ForceGrasp]:
    """Read the grasps of a folder; with corners of the gel, their images are rectified.

    UserError: a table, a column or a video is missing.
    """
    index = folder / "grasps.csv"
    grasps = []
    for row in read_table(index, ("trial", "object")):
        video, table = (folder / f"{row['trial']}.{kind}" for kind in ("avi", "csv"))
        check_there((video, table), index)
        rows = read_table(table, _COLUMNS)
        force, width = (np.array([float(row[name]) for row in rows]) for name in _COLUMNS)
        grasps.append(ForceGrasp(row["trial"], row["object"], video, force, width, corners))
    return grasps
