"""What `touchgoal check-sensor` does."""

import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from touchgoal.control.calibration import check_report
from touchgoal.control.calibration.report import write_picture
from touchgoal.control.calibration.sensor_check import check_sensor
from touchgoal.control.sensors.fingertip_source import (
    fingertip_video,
    is_recorded,
    live_frames,
    recorded_frames,
)
from touchgoal.control.tactile.sensor_models import SensorModel, find_sensor
from touchgoal.launch.check_sensor import Config
from touchgoal.runtime.run_folder import open_run, write_json


def run_command(config: Config) -> None:
    """Watch, print, draw."""
    sensor = find_sensor(config.sensor)
    out = open_run(config.out, "check-sensor", config)
    if is_recorded(config.source):
        frames = recorded_frames(Path(config.source), sensor, config.corners)
    else:
        print(f"leave the gel untouched for a second, then press; {config.seconds:g} s", flush=True)
        frames = _watched(config, sensor)
    ball = None if config.ball_mm is None else config.ball_mm * 1e-3
    check = check_sensor(frames, sensor, ball)
    figures = check_report.figures(check, config.ball_mm, config.weight_g)
    print("\n".join(check_report.lines(check, figures)))
    write_json(out / "metrics.json", figures)
    write_picture(out / "check.png", check_report.picture(check))
    print(f"presses, their change and depth: {out / 'check.png'}")


def _watched(config: Config, sensor: SensorModel) -> Iterator[np.ndarray]:
    """A live sensor's frames until the time is over, or Ctrl-C."""
    video = fingertip_video(config.source, sensor, config.corners)
    video = replace(video, exposure=config.exposure)
    end = time.monotonic() + config.seconds
    with closing(live_frames(video, sensor, config.corners)) as frames:
        try:
            for frame in frames:
                yield frame
                if time.monotonic() > end:
                    return
        except KeyboardInterrupt:
            print("ended")
