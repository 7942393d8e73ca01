"""What `touchgoal record-presses` does."""

from collections.abc import Generator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from touchgoal.control.calibration.press_recorder import PressRecorder
from touchgoal.control.calibration.press_set import MINIMUM, write_presses
from touchgoal.control.interfaces import DriverError
from touchgoal.control.sensors.fingertip_source import (
    fingertip_video,
    is_recorded,
    live_frames,
    recorded_frames,
)
from touchgoal.control.sensors.live_picture import LivePicture
from touchgoal.control.tactile.sensor_models import SENSORS, SensorModel
from touchgoal.launch import calibrate
from touchgoal.launch.record_presses import Config
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.run_folder import open_run


def run_command(config: Config) -> None:
    """Record, keep, calibrate."""
    if config.sensor not in SENSORS:
        raise UserError(f"unknown sensor {config.sensor!r}; choose from: {', '.join(SENSORS)}")
    if config.resume and config.out is None:
        raise UserError("to go on with a recording, name its folder with --out")
    model = SENSORS[config.sensor]
    recorder = PressRecorder(model.image_shape, config.presses_per_part)
    if is_recorded(config.source):
        out = open_run(config.out, "record-presses", config, adds=config.resume)
        _record(recorded_frames(Path(config.source), model, config.corners), recorder, None)
    else:
        frames = _live(config, model)
        out = open_run(config.out, "record-presses", config, adds=config.resume)
        with closing(LivePicture(config.port)) as live:
            print(f"live picture: {live.address}")
            _record(frames, recorder, live)
    kept = len(recorder.images)
    if not kept:
        raise UserError(f"no press was kept; the last hint was: {recorder.hint}")
    folder = out / "presses"
    earlier = len(list(folder.glob("press_*.png")))
    write_presses(recorder.presses(config.ball_mm * 1e-3, earlier), folder, adds=config.resume)
    missing, every = int((config.presses_per_part - recorder.counts).clip(0).sum()), earlier + kept
    print(f"{kept} presses kept, {missing} missing of the map; {every} in all: {folder}")
    if not config.calibrate:
        return
    if every < MINIMUM:
        raise UserError(f"calibration needs {MINIMUM} presses: go on with --out {out} --resume")
    result = out / f"calibration_{every}"
    calibrate.main(calibrate.Config(folder, config.mm_per_pixel, config.sensor, out=result))


def _live(config: Config, model: SensorModel) -> Generator[np.ndarray, None, None]:
    if "://" not in config.source and config.exposure is None:
        raise UserError(
            "give --exposure (v4l2-ctl --list-ctrls shows its range): an exposure that the camera sets "
            "itself changes the light with every press"
        )
    video = fingertip_video(config.source, model, config.corners)
    locked = replace(video, exposure=config.exposure, white_balance=config.white_balance)
    return live_frames(locked, model, config.corners)


def _record(
    frames: Generator[np.ndarray, None, None], recorder: PressRecorder, live: LivePicture | None
) -> None:
    """Feed the recorder until it is complete, the frames end, or a person has had enough."""
    hint = ""
    with closing(frames):
        try:
            for frame in frames:
                recorder.update(frame)
                if live is not None:
                    live.show(recorder.draw_map(frame))
                    if recorder.hint != hint:
                        hint = recorder.hint
                        print(hint, flush=True)
                if recorder.complete:
                    return
        except KeyboardInterrupt:
            print("ended")
        except DriverError as error:  # what was kept so far is worth keeping
            print(f"ended: {error}")
