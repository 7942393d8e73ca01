"""Try a sensor, or a sensor file, on frames of one's own.

SOURCE is a USB serial number, a device (/dev/video2) or a stream's address; or a video, or a folder of
pictures. Leave the gel untouched for the first second, then press: whatever you like, or a ball
(--ball-mm), or lay a weight on it (--weight-g).
"""

from pathlib import Path
from typing import Annotated, Any

import tyro

from touchgoal.runtime.option_types import Corners, Positive, checked_dataclass


@checked_dataclass
class Config:
    """Options of check-sensor."""

    source: Annotated[str, tyro.conf.Positional]
    """USB serial number, device, or stream's address of the sensor; or a recording of it."""
    sensor: str = "gelsight_mini"
    """Model of the sensor (`touchgoal list sensors`), or the folder that calibrate made of it."""
    corners: Corners | None = None
    """Corners of the gel in the camera's picture, x and y in px: top left, top right, bottom left, bottom
    right; of a camera that sees its gel at an angle (gelsight_wedge)."""
    ball_mm: Positive | None = None
    """Radius of the ball that presses, mm: what the depth shows is compared with it."""
    weight_g: Positive | None = None
    """Weight that lies on the gel, g: the force that the pictures show is compared with it."""
    exposure: Positive | None = None
    """Exposure to lock, in the camera's units; not given: as it is set."""
    seconds: Positive = 20.0
    """For how long a live sensor is watched, s; Ctrl-C ends earlier."""
    out: Path | None = None
    """Folder of the run."""


def main(config: Any) -> None:
    """Watch, print what the frames say, and draw the firmest presses."""
    from touchgoal.launch.commands.check_sensor import run_command

    run_command(config)
