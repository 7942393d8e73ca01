"""Simulated against held-out real presses of a ball on two sensors.

Each split fits a sensor file to some presses (of the taxim wheel) and predicts the others. The
background alone and Taxim's table, which was made from all presses, are judged beside it. Model
choices were made on the fitted presses of the first split.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float32

from benchmarks.options import BenchmarkOptions
from benchmarks.real_touch.taxim_peer import PIXEL_PITCH, TaximRenderer, has_jax, real_presses
from touchgoal.control.calibration.calibrate import FittedCalibration, fit
from touchgoal.control.calibration.press_fit import REGION
from touchgoal.control.calibration.press_set import PressSet, split, write_presses
from touchgoal.control.calibration.report import image_errors, mean_errors, side_by_side
from touchgoal.runtime.errors import install_extra
from touchgoal.runtime.option_types import Count, checked_dataclass
from touchgoal.runtime.progress import track


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark tactile-realism."""

    splits: Count = 5
    """Splits into fitted and held-out presses; the median is printed."""
    sensors: tuple[Literal["gelsight", "gelsight_mini"], ...] = ("gelsight", "gelsight_mini")
    """Sensors."""
    save_presses: Path | None = None
    """Also write the real presses into this folder, in the layout of `touchgoal calibrate`."""


N_TEST_PRESSES = {"gelsight": 12, "gelsight_mini": 6}
MAIN_METHOD = "ours, circles corrected"
# Ball radius (m) and contact share at which Taxim does best on the fitted presses, among 1 to 4 mm
# and 0 or 0.4: for circles as labelled, and as moved.
_TAXIM_LABELLED = {"gelsight": (2e-3, 0.4), "gelsight_mini": (3e-3, 0.0)}
_TAXIM_MOVED = {"gelsight": (2e-3, 0.4), "gelsight_mini": (1e-3, 0.4)}
_LEGEND = """corrected: labels corrected by a line fitted to the fitted presses, without the held-out
picture; moved: circles fitted to the held-out picture"""
_CUT = 120, 160  # rows and columns of an example in the image
_EXAMPLES_PER_SENSOR = 2

Colours = Float32[np.ndarray, "h w 3"]


def run(config: Config) -> dict[str, Any]:
    """Fit, predict and compare."""
    cv2.setNumThreads(1)
    rows: list[dict[str, Any]] = []
    examples: list[tuple[Colours, Colours]] = []
    for sensor in config.sensors:
        presses = real_presses(sensor)
        if config.save_presses is not None:
            write_presses(presses, config.save_presses / sensor)
        taxim = TaximRenderer(sensor) if has_jax() else None
        for seed in track(range(config.splits), sensor, "split"):
            train, test = split(presses, N_TEST_PRESSES[sensor], seed)
            fitted = fit(train, PIXEL_PITCH, sensor)
            for method, simulated in _methods(sensor, fitted, train, test, taxim):
                errors = mean_errors([*map(image_errors, test.images, simulated, test.circles)])
                rows.append({"sensor": sensor, "method": method, "seed": seed, **errors})
                if method == MAIN_METHOD and seed == 0:
                    examples += _examples(test, simulated)
    lines = [_table(rows), _LEGEND]
    if not has_jax():
        lines.append(f"taxim's pictures are left out; to compare: {install_extra('peers')}")
    image = side_by_side([real for real, _ in examples], [made for _, made in examples])
    return {"rows": rows, "table": "\n".join(lines), "pictures": {"pictures": image}}


def _methods(
    sensor: str,
    fitted: FittedCalibration,
    train: PressSet,
    given: PressSet,
    taxim: TaximRenderer | None,
) -> Iterator[tuple[str, list[Colours]]]:
    """Return each method's predictions of the held-out images, by name."""
    background = fitted.calibration.background.astype(np.float32)
    test = _with_balls(given, fitted)
    moved = fitted.fit_circles(test)
    yield "background alone", [test.background.astype(np.float32)] * len(test)
    yield "background as the presses leave it", [background] * len(test)
    trusting = fit(train, PIXEL_PITCH, sensor, trust_labels=True)
    trusted = _with_balls(given, trusting)
    yield (
        "ours, circles at face value",
        trusting.simulate(trusted, trusting.correct_labels(trusted)),
    )
    yield MAIN_METHOD, fitted.simulate(test, fitted.correct_labels(test))
    yield "ours, circles moved", fitted.simulate(test, moved)
    if taxim is None:
        return
    labelled = [taxim.render(c, *_TAXIM_LABELLED[sensor]) for c in test.circles]
    yield "taxim table", labelled
    # the table's change of its own untouched image, on our background
    yield "taxim table, on our background", [p - taxim.untouched + background for p in labelled]
    better = [taxim.render(c, *_TAXIM_MOVED[sensor]) for c in moved]
    yield "the same, circles moved", [p - taxim.untouched + background for p in better]


def _with_balls(presses: PressSet, fitted: FittedCalibration) -> PressSet:
    """Give presses of an unknown ball the fitted radius."""
    known = presses.ball_radius
    return replace(presses, ball_radius=np.where(np.isnan(known), fitted.ball_radius.mean(), known))


def _examples(test: PressSet, simulated: list[Colours]) -> list[tuple[Colours, Colours]]:
    """Return the first presses, cut out around the contact, measured and simulated."""
    height, width = _CUT
    cuts = []
    for image, made, circle in zip(test.images, simulated, test.circles, strict=True):
        top = int(np.clip(circle[1] - height / 2, 0, image.shape[0] - height))
        left = int(np.clip(circle[0] - width / 2, 0, image.shape[1] - width))
        cut = slice(top, top + height), slice(left, left + width)
        cuts.append((image[cut].astype(np.float32), made[cut]))
    return cuts[:_EXAMPLES_PER_SENSOR]


def _table(rows: list[dict[str, Any]]) -> str:
    splits = len({r["seed"] for r in rows})
    lines = [
        f"medians over {splits} splits; around the contact: within {REGION:g} labelled radii",
        f"{'sensor':<15}{'n':>6}  {'method':<36}{'L1':>6}{'PSNR':>7}{'SSIM':>7}{'L1, all':>9}",
    ]
    for sensor in dict.fromkeys(r["sensor"] for r in rows):
        for method in dict.fromkeys(r["method"] for r in rows if r["sensor"] == sensor):
            own = [r for r in rows if (r["sensor"], r["method"]) == (sensor, method)]
            l1, psnr, ssim, whole = (
                np.median([r[error] for r in own])
                for error in ("l1_near", "psnr_near", "ssim_near", "l1")
            )
            lines.append(
                f"{sensor:<15}{N_TEST_PRESSES[sensor]:>6}  {method:<36}{l1:>6.2f}{psnr:>7.1f}{ssim:>7.3f}"
                f"{whole:>9.2f}"
            )
    return "\n".join(lines)
