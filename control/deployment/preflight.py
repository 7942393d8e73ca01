"""Checks before an arm moves, one a line; none may fail."""

import shutil
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.arms.client_libraries import FRANKY, UR_RTDE, ClientLibrary
from touchgoal.control.arms.driver_process import error_line
from touchgoal.control.arrays import Image
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.cell.connection import CellConnection, camera_formats
from touchgoal.control.deployment.hand import require_empty_hand
from touchgoal.control.interfaces import Camera, TactileSensor
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.fingertip_health import FingertipHealth
from touchgoal.control.safety.limits import TASK_FORCES
from touchgoal.control.sensors.exchanged import fingertips_exchanged
from touchgoal.control.tactile.background import settling
from touchgoal.control.tactile.contact import coarse, contact_strength, threshold_for
from touchgoal.control.tactile.image_guard import check_untouched
from touchgoal.control.tactile.indentation import require_readable
from touchgoal.control.tactile.markers.tracker import without_dots
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.runtime.errors import CheckResult, UserError

_MIN_RATE_SHARE = 0.8  # share of the camera rate that the cell file states
# Counts by which a fingertip may differ from its sensor file's. Simulated units differ by 1 to 2, a
# grasp makes 20 and more; real units differ by more than simulated ones (unmeasured here).
_TOUCHED_COUNTS = 12.0
_WATCH_SECONDS = 1.0  # s for which cameras are watched, again and again while an exposure settles
_SETTLED = 0.03  # share by which a channel's light may change in that time
_SETTLES_WITHIN = 10.0  # s, at most
# mm between tools by nominal and by the controller's kinematics: a UR's own calibration makes 1 to 2
_CALIBRATED, _OTHER_ARM = 1.0, 10.0
_WATCH_INTERVAL = 0.05  # s between two looks at the fingertips
_MAX_REST_FORCE = 7.5  # N measured at rest above which the arm does not begin
# Bytes/s: both fingertips and two cameras of 256 x 256 take 17e6 as they come, and at most as much
# again once the run is saved.
_EPISODE_RATE = 3.5e7
_SPARE_BYTES = 5e8  # left free beside the episode
_MUJOCO = ClientLibrary("mujoco", "pip install mujoco")
_CLIENTS = {"fr3": FRANKY, "ur5e": UR_RTDE, "sim": _MUJOCO}


def preflight(
    cell: CellConfig,
    connection: CellConnection,
    safety: ActionFilter,
    episodes: Path,
    count_episodes: Callable[[], int],
) -> list[CheckResult]:
    """Return every check in the order of the table.

    `episodes` is the folder that the run records into; `count_episodes` counts those already in it,
    with a UserError if it cannot be continued.
    """
    rates, tips_seen = watch_cameras(connection)
    checks: list[tuple[str, Callable[[], str]]] = [
        ("client", lambda: check_client(cell)),
        ("arm", lambda: _arm(connection, safety)),
        ("kinematics", lambda: _kinematics(connection)),
        ("limits", lambda: _limits(cell, safety)),
        ("ceilings", lambda: _ceilings(cell, safety)),
        ("gripper", lambda: _gripper(cell, connection)),
    ]
    formats = camera_formats(cell)
    for key, camera in connection.cameras.items():
        check = partial(_camera, camera, rates[key], formats[key][0], tips_seen.get(key, []))
        checks.append((key.removeprefix(ft.IMAGE_PREFIX), check))
    if cell.fingertips:
        checks.append(("fingertips", lambda: _fingertips(connection)))
    if connection.load_cell:
        checks.append(("load cell", lambda: _load_cell(connection)))
    checks += [
        ("policy", lambda: f"{cell.task.policy}, at {ft.CONTROL_HZ} Hz"),
        ("disk", lambda: _disk(episodes, cell.task.seconds)),
        ("episodes", lambda: f"{count_episodes()} recorded in {episodes}"),
    ]
    return [_run_check(*check) for check in checks]


def watch_cameras(connection: CellConnection) -> tuple[dict[str, float], dict[str, list[Image]]]:
    """Return the rate of each camera (Hz), by the connection's clock, and each fingertip's frames.

    They are those of one second, when the light of all fingertips is steady or 10 s are over.
    """
    clock = connection.clock
    latest = clock.now() + _SETTLES_WITHIN - _WATCH_SECONDS + 1e-6
    while any(map(_settles, (watched := _watch_once(connection))[1].values())):
        if clock.now() > latest:
            break
    return watched


def _settles(frames: list[Image]) -> bool:
    return len(frames) > 1 and settling(frames[0], frames[-1], _SETTLED)


def _watch_once(connection: CellConnection) -> tuple[dict[str, float], dict[str, list[Image]]]:
    clock, begin, seconds = connection.clock, connection.clock.now(), 0.0
    sequences: dict[str, list[int]] = {key: [] for key in connection.cameras}
    found: dict[str, dict[int, Image]] = {key: {} for key in connection.fingertips}
    while True:
        for key, camera in connection.cameras.items():
            with suppress(Exception):  # of any driver; the camera's own check says so
                frame = camera.read()
                sequences[key].append(frame.sequence)
                if key in found:
                    found[key][frame.sequence] = frame.image
        if (seconds := clock.now() - begin) > _WATCH_SECONDS - 1e-9:
            break
        clock.wait(min(clock.now() + _WATCH_INTERVAL, begin + _WATCH_SECONDS))
    rates = {key: (n[-1] - n[0]) / seconds if n else 0.0 for key, n in sequences.items()}
    return rates, {key: list(frames.values()) for key, frames in found.items()}


def _run_check(what: str, check: Callable[[], str]) -> CheckResult:
    try:
        return CheckResult(what, True, check())
    except Exception as error:  # of any driver, or a disk that takes no file
        return CheckResult(what, False, "", error_line(error))


def check_client(cell: CellConfig) -> str:
    """Return the maker's client library and its version; UserError if it is not installed."""
    client = _CLIENTS[cell.arm]
    if client.version is None:
        raise UserError(f"{client.package} is not installed: {client.install}")
    return f"{client.package} {client.version}"


def _arm(connection: CellConnection, safety: ActionFilter) -> str:
    reading = connection.arm.read()
    if reading.fault:
        raise UserError(reading.fault)
    age = connection.clock.age(reading.stamp)
    if age > safety.watchdogs.state.stop:
        raise UserError(f"its state is {age:.2f} s old: check the network to the controller")
    if np.abs(reading.velocity).max() > 0.05:
        raise UserError("it moves: let it come to rest")
    force = float(np.linalg.norm(reading.wrench[:3]))
    if np.isnan(force):
        raise UserError("it measures no forces here, near a singularity: move it by hand")
    if force > _MAX_REST_FORCE:
        raise UserError(
            f"it measures {force:.1f} N at rest: set the hand's mass in Desk, or clear it"
        )
    safety.start(reading.q)
    return f"{connection.robot.arm.name} at {np.round(reading.q, 2).tolist()} rad, {force:.1f} N"


def _kinematics(connection: CellConnection) -> str:
    """Compare the nominal kinematics, which place everything here, with the controller's own."""
    reading, robot = connection.arm.read(), connection.robot
    if reading.tcp is None:
        return "the controller has none of its own"
    nominal, _ = robot.kinematics().forward(reading.q)
    off = 1e3 * float(np.linalg.norm(reading.tcp - nominal))
    told = f"tool {off:.1f} mm from where the controller has it"
    if off > _OTHER_ARM:
        raise UserError(f"{told}: is it no {robot.arm.name}? set the cell file's arm to its model")
    if off >= _CALIBRATED:
        told += "; the arm's own calibration is not used: heights are off by as much"
    return told


def _limits(cell: CellConfig, safety: ActionFilter) -> str:
    if cell.fingertips is not None:
        require_readable(find_sensor(cell.sensor), safety.limits.indentation)
    watchdogs = safety.watchdogs
    return (
        f"joints up to {safety.joints.velocity.max():.2f} rad/s; holds when images are older than "
        f"{1e3 * watchdogs.observation.hold:.0f} ms or the arm's state than "
        f"{1e3 * watchdogs.state.hold:.0f}"
    )


def _ceilings(cell: CellConfig, safety: ActionFilter) -> str:
    """Return the force ceilings and their source."""
    task = TASK_FORCES.get(cell.task.name)
    ceilings = ("force", "torque", "indentation")
    own = [name for name in ceilings if getattr(cell.safety, name) is not None]
    source = f"{', '.join(own)} as the cell file says; " if own else ""
    limits = safety.limits
    demonstrations = "the default of a task of your own" if len(own) < len(ceilings) else ""
    if task is not None:
        demonstrations = (
            f"demonstrations of {cell.task.name} reach {task.force:g} N and "
            f"{1e3 * task.indentation:.2g} mm"
        )
    return (
        f"stops above {limits.force:.3g} N, {limits.torque:.3g} Nm or {1e3 * limits.indentation:.3g} mm into a "
        f"gel; {source}{demonstrations}"
    )


def _gripper(cell: CellConfig, connection: CellConnection) -> str:
    reading = connection.gripper.read()
    if reading.fault:
        raise UserError(reading.fault)
    if cell.fingertips is not None:
        require_empty_hand(reading)
    holds = ", it holds something" if reading.grasped else ""
    return f"{1e3 * reading.width:.0f} mm wide{holds}"


def _camera(camera: Camera, rate: float, nominal: float, frames: list[Image]) -> str:
    if camera.problem:
        raise UserError(camera.problem)
    untouched = ""
    if isinstance(camera, TactileSensor):
        health, sensor = FingertipHealth(camera.model), camera.model
        for wrong in (health.update(frame) for frame in frames):
            if wrong:
                raise UserError(wrong)
        if _settles(frames):
            raise UserError(
                f"its light still changes after {_SETTLES_WITHIN:g} s: lock its exposure "
                "(fingertips.exposure in the cell file), or let its lamps warm up"
            )
        frames = frames or [camera.read().image]
        middle = np.median(frames, axis=0).astype(np.uint8)
        if wrong := coarse(threshold_for(np.stack(frames), middle)):
            raise UserError(wrong)
        check_untouched(camera.read().image, sensor, "it")
        frame, background = _fingertip(camera)
        # A unit differs from its sensor file; a contact differs by far more.
        strength = float(contact_strength(frame[None], background)[0])
        if strength > _TOUCHED_COUNTS:
            raise UserError(
                f"it looks touched ({strength:.0f} counts): clear it, or if nothing touches it, fit "
                "your own sensor file: touchgoal calibrate"
            )
        untouched = f", untouched ({strength:.1f} counts from its sensor file)"
    if rate < _MIN_RATE_SHARE * nominal:
        raise UserError(
            f"{rate:.1f} images a second instead of {nominal:g}: check its cable, the light and what "
            "else this computer does"
        )
    return f"{rate:.1f} images a second{untouched}"


def _fingertip(camera: TactileSensor) -> tuple[Image, Image]:
    """Return a fingertip's image and its sensor file's background, both without dots."""
    model = camera.model
    return without_dots(camera.read().image, model), load(model.sensor_file).background


def _fingertips(connection: CellConnection) -> str:
    """Check that each fingertip looks like its own sensor file, where the two files tell them apart."""
    left, right = (_fingertip(connection.fingertips[key]) for key in ft.TACTILE)
    frames = left[0], right[0]
    if fingertips_exchanged(frames, (left[1], right[1])):
        raise UserError(
            "they look exchanged, each like the other's sensor file: exchange fingertips.left and "
            "fingertips.right in the cell file, or the two sensors"
        )
    if fingertips_exchanged(frames, (right[1], left[1])):  # which holds, the other way round
        return "each looks like its own sensor file"
    return "left and right not checked: their sensor files do not tell them apart"


def _load_cell(connection: CellConnection) -> str:
    assert connection.load_cell is not None
    reading = connection.load_cell.read()
    return f"{reading.force:.1f} N, {reading.rejected} lines refused"


def _disk(episodes: Path, seconds: float) -> str:
    folder = next(p for p in (episodes, *episodes.resolve().parents) if p.exists())
    free, needed = shutil.disk_usage(folder).free, _SPARE_BYTES + _EPISODE_RATE * seconds
    if free < needed:
        raise UserError(
            f"{free / 1e9:.1f} GB are free in {folder}: make room for {needed / 1e9:.1f} GB"
        )
    return f"{free / 1e9:.0f} GB free"
