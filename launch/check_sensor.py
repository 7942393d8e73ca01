"""Check a sensor, or a sensor file, on your own frames: noise, drift, contact, depth, force, markers.

SOURCE is a USB serial number, a device (/dev/video2), a stream's address, a video, or a folder of
images. Leave the gel untouched for the first second, then press any object, press a ball
(--ball-mm), or lay a weight on the gel (--weight-g).
"""

from itertools import chain, islice
from pathlib import Path
from typing import Annotated

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
    """Corners of the gel in the camera's image, x and y in px: top left, top right, bottom left, bottom
    right; for a camera that sees its gel at an angle (gelsight_wedge)."""
    background: Path | None = None
    """Clip (or image) of the sensor untouched, for frames that do not begin so. Default: the first."""
    ball_mm: Positive | None = None
    """Radius of the pressed ball, mm, to compare with the radius that the depth shows."""
    weight_g: Positive | None = None
    """Weight on the gel, g, to compare with the force that the images show."""
    exposure: Positive | None = None
    """Exposure to lock, in the camera's units; default: as it is set."""
    seconds: Positive = 20.0
    """For how long a live sensor is watched, s; Ctrl-C ends earlier."""
    out: Path | None = None
    """Folder of the run."""


def main(config: Config) -> None:
    """Read the frames, print what they show, and draw the firmest presses."""
    from touchgoal.control.calibration import check_report
    from touchgoal.control.calibration.sensor_check import check_sensor
    from touchgoal.control.sensors import fingertip_source
    from touchgoal.control.tactile.background import SETTLES_WITHIN
    from touchgoal.control.tactile.sensor_models import find_sensor
    from touchgoal.runtime.image_file import write_image
    from touchgoal.runtime.json_file import write_json
    from touchgoal.runtime.run_folder import open_run

    sensor, seconds = find_sensor(config.sensor), config.seconds
    ball = config.ball_mm and config.ball_mm * 1e-3
    out = open_run(config.out, "check-sensor", config)
    if not fingertip_source.is_recorded(config.source):
        print(f"leave the gel untouched for a second, then press; {seconds:g} s", flush=True)
    frames = fingertip_source.open_frames(
        config.source, sensor, config.corners, config.exposure, seconds=seconds
    )
    if config.background is not None:
        untouched = fingertip_source.recorded_frames(config.background, sensor, config.corners)
        frames = chain(islice(untouched, SETTLES_WITHIN), frames)
    check = check_sensor(frames, sensor, ball)
    figures = check_report.figures(check, config.ball_mm, config.weight_g)
    print("\n".join(check_report.lines(check, figures)))
    write_json(out / "metrics.json", figures)
    write_image(out / "check.png", check_report.image(check))
    print(f"presses, their change and depth: {out / 'check.png'}")
