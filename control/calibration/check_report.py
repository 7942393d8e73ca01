"""What `check-sensor` prints and draws."""

from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from touchgoal.control.calibration.sensor_check import PressRead, SensorCheck
from touchgoal.control.tactile.background import Drift

_SHOWN = 4  # presses in the picture
_CONTRAST = 4  # of the change column
_GRAVITY = 9.81  # m/s^2
_MARGIN = 2.0  # times the threshold that a usual touch should have
_UNLIKE = 5.0  # counts of local change; drift of the full spread between real touches gives 3
_DEPTH_OFF, _FORCE_OFF = 0.1, 0.2


def figures(check: SensorCheck, ball_mm: float | None, weight_g: float | None) -> dict[str, Any]:
    """What metrics.json holds; lengths in mm, forces in N, light in counts."""
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
    return {
        "frames": check.frames,
        "touching": check.touching,
        "noise": check.noise,
        "drift": _drift(check.drift),
        "drift_from_file": _drift(check.drift_from_file),
        "unlike_file": check.unlike_file,
        "threshold": check.threshold,
        "untouched": check.untouched,
        "touched": check.touched,
        "markers": check.markers,
        "largest_shift_px": check.largest_shift,
        "presses": len(check.presses),
        **read,
    }


def lines(check: SensorCheck, figures: dict[str, Any]) -> list[str]:
    """The same as people read it, with what to do where something is off."""
    said = [f"frames       {check.frames}, {check.touching} of them touched"]
    if check.noise is not None:
        said.append(f"noise        {check.noise:.2f} counts a pixel")
    said += [
        _light("drift", check.drift, "lock the exposure, and let the sensor warm up"),
        _light("sensor file", check.drift_from_file, "calibrate this sensor anew"),
    ]
    if check.unlike_file > _UNLIKE:
        said.append(
            f"             the untouched gel is not the sensor file's ({check.unlike_file:.1f} counts in "
            "one spot): lengths and forces are not this sensor's until it is calibrated"
        )
    said.append(_contact(check))
    if check.markers is not None:
        said.append(
            f"markers      {100 * check.markers:.0f} % seen, moved by up to {check.largest_shift:.1f} px"
        )
    if "radius_mm" in figures:
        low, middle, high = figures["radius_mm"]
        off = middle / figures["ball_mm"] - 1
        said.append(
            f"ball         {figures['ball_mm']:g} mm reads {middle:.2f} mm (quartiles {low:.2f} to "
            f"{high:.2f}), {1e3 * figures['residual_mm']:.0f} um from a sphere"
            + (
                ""
                if abs(off) <= _DEPTH_OFF
                else ": calibrate this sensor (touchgoal record-presses)"
            )
        )
    elif "depth_mm" in figures:
        said.append(
            "deepest      {1:.2f} mm (quartiles {0:.2f} to {2:.2f})".format(*figures["depth_mm"])
        )
    if "unexplained" in figures:
        said.append(
            f"simulation   leaves {100 * figures['unexplained'][1]:.0f} % of the change unexplained, of the depth "
            "that it reads itself"
        )
    if "force" in figures:
        low, middle, high = figures["force"]
        line = f"force        {middle:.1f} N (quartiles {low:.1f} to {high:.1f})"
        if "weight" in figures:
            weight = figures["weight"]
            line += f" of a weight of {weight:.1f} N"
            if abs(middle / weight - 1) > _FORCE_OFF:
                line += f": multiply the model's foundation_modulus by {weight / middle:.2f}"
        said.append(line)
    return said


def picture(check: SensorCheck) -> UInt8[np.ndarray, "H W 3"]:
    """Rows of press, the simulator's picture of its depth, changes of both times 4 about grey, depth."""
    rows = [_row(press, check.background) for press in check.presses[:_SHOWN]]
    empty = np.hstack([check.background] * 2)
    return np.vstack(rows or [empty])


def _row(press: PressRead, background: UInt8[np.ndarray, "h w 3"]) -> np.ndarray:
    drawn, simulated = (
        np.clip(128 + _CONTRAST * (frame.astype(np.float32) - background), 0, 255).astype(np.uint8)
        for frame in (press.frame, press.drawn)
    )
    deepest = max(float(press.depth.max()), 1e-6)
    grey = (255 * np.clip(press.depth / deepest, 0, 1)).astype(np.uint8)
    depth = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)[..., ::-1].copy()
    text = f"{1e3 * deepest:.2f} mm"
    if press.circle is not None and press.ball is not None:
        x, y, radius = press.circle.round().astype(int).tolist()
        cv2.circle(drawn, (x, y), radius, (255, 255, 255), 1, cv2.LINE_AA)
    cv2.putText(
        depth, text, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA
    )
    return np.hstack([press.frame, press.drawn, drawn, simulated, depth])


def _contact(check: SensorCheck) -> str:
    line = (
        f"contact      told from {check.threshold:.1f} counts on; untouched frames reach "
        f"{check.untouched:.1f}"
    )
    if not check.touched:
        return line + ", nothing touched"
    line += f", touches {check.touched:.1f}"
    if check.touched < _MARGIN * check.threshold:
        line += ": a narrow margin; send pictures with less compression, or press harder"
    return line


def _light(name: str, drift: Drift, remedy: str) -> str:
    gain = 100 * (drift.gain - 1)
    said = f"{name:<13}light {gain.min():+.1f} to {gain.max():+.1f} %, {drift.pattern.max():.1f} counts of pattern"
    return said + (f": {remedy}" if drift.large else "")


def _drift(drift: Drift) -> dict[str, list[float]]:
    return {
        "gain": drift.gain.tolist(),
        "offset": drift.offset.tolist(),
        "pattern": drift.pattern.tolist(),
    }


def _quartiles(values: list[float]) -> list[float]:
    return np.quantile(values, [0.25, 0.5, 0.75]).tolist()
