"""Printed lines, metrics and image of `check-sensor`."""

from dataclasses import asdict, fields
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from touchgoal.control.arrays import Image
from touchgoal.control.calibration.report import heading
from touchgoal.control.calibration.sensor_check import PressReading, SensorCheck
from touchgoal.control.tactile.background import Drift
from touchgoal.control.tactile.contact import coarse
from touchgoal.control.tactile.image_guard import UNEXPLAINED

_SHOWN = 4  # presses in the image
_CONTRAST = 4  # factor on the change in its column
_COLUMNS = ("frame", "simulated", f"change x {_CONTRAST}", "the same, simulated", "depth")
_GRAVITY = 9.81  # m/s^2
_MARGIN = 2.0  # times the threshold that a usual touch should have
_UNLIKE = 5.0  # counts of local change; the usual drift between real touches gives 3
_DEPTH_OFF, _FORCE_OFF = 0.1, 0.2


def figures(check: SensorCheck, ball_mm: float | None, weight_g: float | None) -> dict[str, Any]:
    """Return the content of metrics.json; lengths in mm, forces in N, light in counts."""
    balls = [press.ball for press in check.presses if press.ball is not None]
    read: dict[str, Any] = {}
    if ball_mm is not None and balls:
        radii = [ball.radius * ball_mm for ball in balls]
        residual = 1e3 * float(np.median([ball.residual for ball in balls]))
        read |= {"ball_mm": ball_mm, "radius_mm": _quartiles(radii), "residual_mm": residual}
    if check.presses:
        read["depth_mm"] = _quartiles([1e3 * float(press.depth.max()) for press in check.presses])
        read["unexplained"] = _quartiles([press.unexplained for press in check.presses])
        read["force"] = _quartiles([press.force for press in check.presses])
    if weight_g is not None:
        read["weight"] = weight_g * 1e-3 * _GRAVITY
    plain = {field.name: getattr(check, field.name) for field in fields(check)}
    del plain["background"]
    for name in ("drift", "drift_from_file"):
        plain[name] = {part: value.tolist() for part, value in asdict(plain[name]).items()}
    return {**plain, "presses": len(check.presses), **read}


def lines(check: SensorCheck, figures: dict[str, Any]) -> list[str]:
    """Return the printed lines, with the remedy where a figure is off."""
    printed = [f"frames       {check.frames}, {check.touching} of them touched"]
    if check.torn:
        printed.append(
            f"             {check.torn} are torn or rolled and left out: check the cable and the decoder"
        )
    if check.noise is not None:
        printed.append(f"noise        {check.noise:.2f} counts a pixel")
    printed += [
        _light("drift", check.drift, "lock the exposure, and let the sensor warm up"),
        _light("sensor file", check.drift_from_file, "calibrate this sensor"),
    ]
    if check.unlike_file > _UNLIKE and not check.images_only:
        printed.append(
            "             the untouched gel differs from the sensor file's by "
            f"{check.unlike_file:.1f} counts in one spot: depths and forces are nominal until this "
            "sensor is calibrated"
        )
    printed.append(_contact(check))
    if check.markers is not None:
        shift = f"moved by up to {check.largest_shift_px:.1f} px"
        printed.append(f"markers      {100 * check.markers:.0f} % found, {shift}")
    if check.images_only:
        printed.append(f"images only  {check.images_only}")
    if refused := check.presses_unexplained:
        printed.append(
            f"refused      {refused} of {refused + len(check.presses)} presses: the sensor file "
            f"leaves more than {100 * UNEXPLAINED:.0f} % of their change unexplained; calibrate this "
            "sensor (touchgoal record-presses)"
        )
    if "radius_mm" in figures:
        printed.append(_ball(figures))
    elif "depth_mm" in figures:
        low, middle, high = figures["depth_mm"]
        printed.append(f"deepest      {middle:.2f} mm (quartiles {low:.2f} to {high:.2f})")
    if check.presses:
        printed.append(
            f"simulation   leaves {100 * figures['unexplained'][1]:.0f} % of the change unexplained"
        )
        printed.append(_force(figures))
    return printed


def image(check: SensorCheck) -> UInt8[np.ndarray, "H W 3"]:
    """Draw one row per press: frame, simulated frame, change of each times 4 about grey, depth."""
    rows = [_row(press, check.background) for press in check.presses[:_SHOWN]]
    head = heading(_COLUMNS if rows else ("untouched",), check.background.shape[1])
    return np.vstack([head, *(rows or [check.background])])


def _ball(figures: dict[str, Any]) -> str:
    low, middle, high = figures["radius_mm"]
    line = (
        f"ball         {figures['ball_mm']:g} mm reads {middle:.2f} mm (quartiles {low:.2f} to "
        f"{high:.2f}), {1e3 * figures['residual_mm']:.0f} um from a sphere"
    )
    off = abs(middle / figures["ball_mm"] - 1) > _DEPTH_OFF
    return line + ": calibrate this sensor (touchgoal record-presses)" * off


def _force(figures: dict[str, Any]) -> str:
    low, middle, high = figures["force"]
    line = f"force        {middle:.1f} N (quartiles {low:.1f} to {high:.1f})"
    if "weight" in figures:
        weight = figures["weight"]
        line += f" under a weight of {weight:.1f} N"
        if abs(middle / weight - 1) > _FORCE_OFF:
            line += f": multiply the model's foundation_modulus by {weight / middle:.2f}"
    return line


def _row(press: PressReading, background: Image) -> np.ndarray:
    drawn, simulated = (
        np.clip(128 + _CONTRAST * (frame.astype(np.float32) - background), 0, 255).astype(np.uint8)
        for frame in (press.frame, press.drawn)
    )
    deepest = max(float(press.depth.max()), 1e-6)
    grey = (255 * np.clip(press.depth / deepest, 0, 1)).astype(np.uint8)
    depth = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)[..., ::-1].copy()
    white, font = (255, 255, 255), cv2.FONT_HERSHEY_SIMPLEX
    if press.circle is not None and press.ball is not None:
        x, y, radius = press.circle.round().astype(int).tolist()
        cv2.circle(drawn, (x, y), radius, white, 1, cv2.LINE_AA)
    text = f"deepest {1e3 * deepest:.2f} mm, {press.force:.1f} N"
    cv2.putText(depth, text, (8, 20), font, 0.5, white, 1, cv2.LINE_AA)
    return np.hstack([press.frame, press.drawn, drawn, simulated, depth])


def _contact(check: SensorCheck) -> str:
    line = f"contact      from {check.threshold:.1f} counts on; untouched frames reach "
    line += f"{check.untouched:.1f}"
    if wrong := coarse(check.threshold):
        line += f"\n             {wrong}"
    if not check.touched:
        return line + "; nothing touched"
    line += f", touches {check.touched:.1f}"
    if check.touched < _MARGIN * check.threshold:
        line += ": a narrow margin; send images with less compression, or press harder"
    return line


def _light(name: str, drift: Drift, remedy: str) -> str:
    gain = 100 * (drift.gain - 1)
    line = f"{name:<13}light {gain.min():+.1f} to {gain.max():+.1f} %, "
    line += f"{drift.pattern.max():.1f} counts of pattern"
    return line + (f": {remedy}" if drift.large else "")


def _quartiles(values: list[float]) -> list[float]:
    return np.quantile(values, [0.25, 0.5, 0.75]).tolist()
