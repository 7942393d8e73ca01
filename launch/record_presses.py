"""Record presses of a ball all over a sensor's gel, and fit its sensor file to them.

SOURCE is a USB serial number, a device (/dev/video2), a stream's address, or a recording: a video
or a folder of images. Leave the gel untouched for a second. Then press the ball where the live
image shows, hold still until the press is recorded, and lift. Ctrl-C ends and keeps the presses.
"""

from contextlib import closing, nullcontext
from pathlib import Path
from typing import Annotated

import tyro
from pydantic import Field

from touchgoal.runtime.option_types import Corners, Count, Port, Positive, checked_dataclass


@checked_dataclass
class Config:
    """Options of record-presses."""

    source: Annotated[str, tyro.conf.Positional]
    """USB serial number, device, or stream's address of the sensor; or a recording of it."""
    ball_mm: Positive
    """Radius of the ball, mm: measure it, because images do not show it."""
    mm_per_pixel: Positive
    """Length on the gel that a pixel shows, mm."""
    sensor: str = "gelsight_mini"
    """Model of the sensor (`touchgoal list sensors`)."""
    exposure: Positive | None = None
    """Exposure to lock, in the camera's units (v4l2-ctl --list-ctrls); needed for a local camera."""
    white_balance: Annotated[int, Field(ge=1000, le=15_000)] | None = None
    """White balance to lock, K; default: as it is set."""
    corners: Corners | None = None
    """Corners of the gel in the camera's image, x and y in px: top left, top right, bottom left, bottom
    right; for a camera that sees its gel at an angle (gelsight_wedge)."""
    presses_per_part: Count = 2
    """Presses wanted in each of the 12 parts of the image."""
    port: Port = 8095
    """Port of the live image, for a browser on this computer."""
    resume: bool = False
    """Go on in the folder --out, with another ball or more presses of this one."""
    calibrate: bool = True
    """Fit the sensor file when enough presses are recorded."""
    out: Path | None = None
    """Folder of the run, with the presses in `presses/` and the sensor file in `calibration_N/`."""


def main(config: Config) -> None:
    """Record until the map is full, the recording ends or Ctrl-C; then fit."""
    from touchgoal.control.calibration.press_recorder import PressRecorder, record_presses
    from touchgoal.control.calibration.press_set import MINIMUM, write_presses
    from touchgoal.control.sensors.fingertip_source import is_recorded, open_frames
    from touchgoal.control.sensors.live_image import LiveImage
    from touchgoal.control.tactile.sensor_models import find_model
    from touchgoal.launch import calibrate
    from touchgoal.runtime.errors import UserError
    from touchgoal.runtime.run_folder import open_run

    model, recorded = find_model(config.sensor), is_recorded(config.source)
    if config.resume and config.out is None:
        raise UserError("--resume: name the folder of the recording with --out")
    if config.exposure is None and not recorded and "://" not in config.source:
        raise UserError(
            "give --exposure (v4l2-ctl --list-ctrls shows its range): automatic exposure changes "
            "the light with every press"
        )
    frames = open_frames(
        config.source, model, config.corners, config.exposure, config.white_balance
    )
    out = open_run(config.out, "record-presses", config, adds=config.resume)
    recorder = PressRecorder(model.image_shape, config.presses_per_part)
    with closing(frames), nullcontext() if recorded else closing(LiveImage(config.port)) as live:
        if live is not None:
            print(f"live image: {live.address}")
        record_presses(frames, recorder, live)
    if not recorder.images:
        raise UserError(f"no press was recorded; the last hint was: {recorder.hint}")
    folder = out / "presses"
    earlier = len(list(folder.glob("press_*.png")))
    write_presses(recorder.presses(config.ball_mm * 1e-3, earlier), folder, adds=config.resume)
    missing = int((config.presses_per_part - recorder.counts).clip(0).sum())
    total = earlier + len(recorder.images)
    print(
        f"{len(recorder.images)} presses recorded, {missing} missing of the map; {total} in {folder}"
    )
    if not config.calibrate:
        return
    if total < MINIMUM:
        raise UserError(f"calibration needs {MINIMUM} presses: go on with --out {out} --resume")
    result = out / f"calibration_{total}"
    calibrate.main(calibrate.Config(folder, config.mm_per_pixel, config.sensor, out=result))
