"""What is looked at before an arm moves: one finding a line; nothing goes on with one that fails."""

import importlib.metadata
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.cell.config import Rig
from touchgoal.control.cell.connection import Station
from touchgoal.control.checks import Finding
from touchgoal.control.errors import UserError
from touchgoal.control.interfaces import Camera, DriverError, TactileSensor
from touchgoal.control.safety.action_filter import Safety
from touchgoal.control.tactile.contact import contact_strength
from touchgoal.control.tactile.markers import find_markers, without_markers
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.episodes.store import EpisodeWriter
from touchgoal.policies.deploy.actors import learned

_LEAST_RATE = 0.8  # of what the rig says of a camera
# Counts by which a fingertip may differ from its sensor file's. Simulated units differ by 1 to 2, a
# grasp makes 20 and more; real units differ by more than simulated ones (unmeasured here).
_TOUCHED = 12.0
_LOOK = 1.0  # s for which cameras are watched
_DISK = 2e9  # bytes: a 40 s episode with both fingertips takes 0.4 GB at most
_CLIENTS = {"fr3": "franky-control", "ur5e": "ur-rtde", "sim": "mujoco"}


def preflight(rig: Rig, station: Station, safety: Safety, episodes: Path) -> list[Finding]:
    """Every check, in the order of the table."""
    rates = watch(station)
    checks: list[tuple[str, Callable[[], str]]] = [
        ("client", lambda: _client(rig)),
        ("arm", lambda: _arm(station, safety)),
        ("limits", lambda: _limits(safety)),
        ("gripper", lambda: _gripper(station)),
    ]
    for key, camera in station.cameras.items():
        nominal = _nominal(rig, key)
        check = partial(_camera, camera, rates[key], nominal)
        checks.append((key.removeprefix(ft.IMAGE_PREFIX), check))
    if station.load_cell:
        checks.append(("load cell", lambda: _load_cell(station)))
    checks += [
        ("policy", lambda: _policy(rig)),
        ("disk", lambda: _disk(episodes)),
        ("episodes", lambda: _episodes(episodes)),
    ]
    return list(_findings(checks))


def watch(station: Station) -> dict[str, float]:
    """At what rate each camera runs (Hz), by the station's clock."""
    begin = station.clock.now()
    before = _sequences(station)
    station.clock.wait(begin + _LOOK)
    after, seconds = _sequences(station), station.clock.now() - begin
    return {key: (after[key] - before[key]) / seconds for key in after}


def _sequences(station: Station) -> dict[str, int]:
    """How many pictures each camera has taken; 0 of one that is broken, which its check tells."""
    counts = dict.fromkeys(station.cameras, 0)
    for key, camera in station.cameras.items():
        with suppress(DriverError):
            counts[key] = camera.read().sequence
    return counts


def _findings(checks: list[tuple[str, Callable[[], str]]]) -> Iterator[Finding]:
    for what, check in checks:
        try:
            yield Finding(what, True, check())
        except (UserError, DriverError) as error:
            yield Finding(what, False, "", str(error))


def _client(rig: Rig) -> str:
    name = _CLIENTS[rig.arm]
    try:
        return f"{name} {importlib.metadata.version(name)}"
    except importlib.metadata.PackageNotFoundError as error:
        raise UserError(f"{name} is not installed: pip install {name}") from error


def _arm(station: Station, safety: Safety) -> str:
    reading = station.arm.read()
    if reading.fault:
        raise UserError(reading.fault)
    age = station.clock.age(reading.stamp)
    if age > safety.watchdogs.state.stop:
        raise UserError(f"its state is {age:.2f} s old: check the network to the controller")
    if np.abs(reading.velocity).max() > 0.05:
        raise UserError("it moves: let it come to rest")
    force = float(np.linalg.norm(reading.wrench[:3]))
    if force > safety.limits.force / 2:
        raise UserError(f"it feels {force:.1f} N at rest: set the hand's mass in Desk, or clear it")
    safety.start(reading.q)
    return f"{station.robot.arm.name} at {np.round(reading.q, 2).tolist()} rad, {force:.1f} N"


def _limits(safety: Safety) -> str:
    limits, dogs = safety.limits, safety.watchdogs
    return (
        f"{safety.joints.velocity.max():.2f} rad/s, {limits.force:g} N, {limits.torque:g} Nm, "
        f"gel {1e3 * limits.touch:g} mm, pictures {1e3 * dogs.observation.hold:.0f} ms, state {1e3 * dogs.state.hold:.0f} ms"
    )


def _gripper(station: Station) -> str:
    reading = station.gripper.read()
    if reading.fault:
        raise UserError(reading.fault)
    return f"{1e3 * reading.width:.0f} mm"


def _nominal(rig: Rig, key: str) -> float:
    if key in ft.TACTILE:
        assert rig.fingertips is not None
        return rig.fingertips.rate or find_sensor(rig.sensor).frame_rate
    return rig.cameras[key.removeprefix(ft.IMAGE_PREFIX)].rate


def _camera(camera: Camera, rate: float, nominal: float) -> str:
    if camera.trouble:
        raise UserError(camera.trouble)
    untouched = ""
    if isinstance(camera, TactileSensor):
        frame, model = camera.read().image, camera.model
        if model.markers is not None:  # every unit's dots lie elsewhere
            dots = find_markers(frame, model.markers, model.pixel_pitch).positions
            frame = without_markers(frame, dots, model.markers.diameter / model.pixel_pitch / 2)
        background = load(model.sensor_file).background
        # A unit differs from the sensor file's; a contact is told by far more than that.
        strength = float(contact_strength(frame[None], background)[0])
        if strength > _TOUCHED:
            raise UserError(
                f"it looks touched ({strength:.0f} counts): clear it, or if it is not, fit your "
                "own sensor file: touchgoal calibrate"
            )
        untouched = f", {strength:.1f} counts from the sensor file's untouched gel"
    if rate < _LEAST_RATE * nominal:
        raise UserError(f"{rate:.1f} of {nominal:g} pictures a second: check cable, light and load")
    return f"{rate:.1f} Hz{untouched}"


def _load_cell(station: Station) -> str:
    assert station.load_cell is not None
    reading = station.load_cell.read()
    return f"{reading.force:.1f} N, {reading.rejected} lines refused"


def _policy(rig: Rig) -> str:
    learned(rig)
    return f"{rig.task.policy}, at {ft.CONTROL_HZ} Hz"


def _disk(episodes: Path) -> str:
    folder = next(p for p in (episodes, *episodes.resolve().parents) if p.exists())
    free = shutil.disk_usage(folder).free
    if free < _DISK:
        raise UserError(f"{free / 1e9:.1f} GB are free in {folder}: make room for {_DISK / 1e9:g}")
    return f"{free / 1e9:.0f} GB free"


def _episodes(episodes: Path) -> str:
    return f"{len(EpisodeWriter(episodes, fps=ft.CONTROL_HZ))} recorded in {episodes}"
