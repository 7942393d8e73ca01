"""Record presses of a ball all over a sensor's gel, and fit its sensor file to them.

SOURCE is a USB serial number, a device (/dev/video2) or a stream's address; or a video, or a folder
of pictures, of such a recording. Leave the gel untouched for a second, then press the ball where the
live picture says, hold still until it is kept, and lift. Ctrl-C ends; what was kept is on disk.
"""

from pathlib import Path
from typing import Annotated, Any

import tyro
from pydantic import Field

from touchgoal.runtime.option_types import Corners, Count, Port, Positive, checked_dataclass


@checked_dataclass
class Config:
    """Options of record-presses."""

    source: Annotated[str, tyro.conf.Positional]
    """USB serial number, device, or stream's address of the sensor; or a recording of it."""
    ball_mm: Positive
    """Radius of the ball, mm: measure it, for no picture tells it."""
    mm_per_pixel: Positive
    """Length on the gel that a pixel shows, mm."""
    sensor: str = "gelsight_mini"
    """Model of the sensor (`touchgoal list sensors`)."""
    exposure: Positive | None = None
    """Exposure to lock, in the camera's units (v4l2-ctl --list-ctrls); a device needs it."""
    white_balance: Annotated[int, Field(ge=1000, le=15_000)] | None = None
    """White balance to lock, K; not given: as it is set."""
    corners: Corners | None = None
    """Corners of the gel in the camera's picture, x and y in px: top left, top right, bottom left, bottom
    right; of a camera that sees its gel at an angle (gelsight_wedge)."""
    presses_per_part: Count = 2
    """Presses wanted in each of the 12 parts of the picture."""
    port: Port = 8095
    """Where a browser on this computer finds the live picture."""
    resume: bool = False
    """Go on in the folder --out, with another ball or more presses of this one."""
    calibrate: bool = True
    """Fit the sensor file when enough presses are recorded."""
    out: Path | None = None
    """Folder of the run; the presses go to its `presses/`, the sensor file to `calibration_N/` (N presses)."""


def main(config: Any) -> None:
    """Record until the map is full, the recording ends or Ctrl-C; then fit."""
    from touchgoal.launch.commands.record_presses import run_command

    run_command(config)
