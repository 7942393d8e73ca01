"""Sharpness of simulated touch: the spectrum of what a contact changes, beside real sensors.

A touch's change from the untouched image, brightness removed, is split into five bands by
differences of Gaussians. In the contact, and with the camera's noise taken out, the root mean
square of each band is the figure of a touch. A video counts as one touch: the mean power of its five
frames of the largest change.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.options import BenchmarkOptions
from benchmarks.real_touch.property_probe import interval
from touchgoal.control.arrays import Image
from touchgoal.control.tactile.light_gain import remove_gain
from touchgoal.control.tactile.sensor_models import SENSORS
from touchgoal.encoders.whitening.simulated_surfaces import sensor_units, visible_press
from touchgoal.episodes.importers.labelled_videos import firmest_frames, read_labelled_videos
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import read_image
from touchgoal.runtime.option_types import Count, Seed, checked_dataclass
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.tactile.optics import render_untouched
from touchgoal.sim_envs.tactile.rig.surfaces import random_surface


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark touch-spectrum."""

    mini: Path = field(kw_only=True)
    """Folder of real videos of a GelSight Mini, laid out as PhysiCLeAR's."""
    digit: Path = field(kw_only=True)
    """Folder of real touches of a DIGIT: touch/THING/*.jpg, as in visuo-tactile-clustering."""
    surfaces: Count = 400
    """Random surfaces, each pressed once, for a sensor."""
    every: Count = 1
    """Use every n-th real video."""
    seed: Seed = 0
    """Random seed of simulated presses."""


BANDS = (1.2, 2.5, 5.0, 10.0, 20.0)  # px; the first holds everything finer, too
_DIGIT_DEFOCUS = 4.0  # px: chosen on half of the DIGIT's things, among 3, 4 and 5
_EDGE = 2**0.5  # a band reaches this factor to both sides
_LEAST_AREA = 0.01  # share of an image that a contact covers
_NOISE_AWAY = 15  # px from the contact
_TICKS = (0.125, 0.25, 0.5, 1, 2, 4, 8)  # counts


@dataclass(frozen=True)
class Touches:
    """Power in each band of some touches, counts^2, and the thing of each."""

    powers: Float[np.ndarray, "n 5"]
    things: list[str]

    def of(self, tuned: bool) -> "Touches":
        """Return the touches of every other thing: those that surfaces were tuned to, or the rest."""
        names = sorted(set(self.things))
        kept = np.isin(self.things, names[::2] if tuned else names[1::2])
        return Touches(self.powers[kept], [t for t, k in zip(self.things, kept, strict=True) if k])


def run(config: Config) -> dict[str, Any]:
    """Compare real and simulated touches of two sensors."""
    cv2.setNumThreads(1)
    rows = []
    for sensor, real in (
        ("gelsight_mini", _mini(config.mini, config.every)),
        ("digit", read_digit(config.digit)),
    ):
        made = simulated_touches(sensor, config.surfaces, config.seed)
        rows.append({"sensor": sensor, "touches": "simulated", **_figures(made, made)})
        for name, tuned in (("real, tuned to", True), ("real, held out", False)):
            rows.append({"sensor": sensor, "touches": name, **_figures(real.of(tuned), made)})
    return {"rows": rows, "table": _table(rows), "pictures": {"touch_spectrum": _plot(rows)}}


def band_powers(
    change: Float32[np.ndarray, "h w 3"], where: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "5"]:
    """Return the mean square of a change (counts) in each band, over some pixels."""
    powers, finer = [], change
    for scale in BANDS:
        coarser = cv2.GaussianBlur(change, (0, 0), scale * _EDGE)
        powers.append(float(((finer - coarser)[where] ** 2).mean()))
        finer = coarser
    return np.array(powers)


def _contact(change: Float32[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    strength = cv2.GaussianBlur(np.abs(change).max(2), (0, 0), 3)
    return strength > max(8.0, 0.3 * float(np.quantile(strength, 0.98)))


def _touch(
    image: Image, untouched: Float32[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "2 5"] | None:
    """Return the powers in a touch's contact and away from it (noise); None without contact."""
    change = (remove_gain(image, untouched) - untouched).astype(np.float32)
    contact = _contact(change)
    size = 2 * _NOISE_AWAY + 1
    away = cv2.dilate(contact.view(np.uint8), np.ones((size, size), np.uint8)) == 0
    if contact.mean() < _LEAST_AREA or not away.any():
        return None
    return np.stack([band_powers(change, contact), band_powers(change, away)])


def _mini(folder: Path, every: int) -> Touches:
    rows, things = [], []
    for video in track(read_labelled_videos(folder)[::every], "videos", "video"):
        frames, untouched = video.open()
        firmest = frames[firmest_frames(frames, untouched)]
        found = [r for f in firmest if (r := _touch(f, untouched.astype(np.float32))) is not None]
        if found:
            contact, noise = np.mean(found, 0)[0], np.median(found, 0)[1]
            rows.append(np.maximum(contact - noise, 0))
            things.append(video.object)
    return Touches(np.array(rows), things)


def read_digit(folder: Path) -> Touches:
    """Read images of touches, their median as the untouched one; UserError if there are none."""
    paths = sorted(folder.glob("touch/*/*.jpg"))
    touches = [image for path in paths if (image := read_image(path)) is not None]
    if not paths or len(touches) < len(paths):
        raise UserError(f"{folder}: images are missing or damaged; expected touch/THING/*.jpg")
    images = np.stack(touches)
    untouched = np.median(images, 0).astype(np.float32)  # no pixel is touched in most of them
    found = [_touch(image, untouched) for image in track(images, "images", "image")]
    kept = [(r, p.parent.name) for r, p in zip(found, paths, strict=True) if r is not None]
    noise = np.median([r[1] for r, _ in kept], 0)
    return Touches(np.maximum([r[0] - noise for r, _ in kept], 0), [name for _, name in kept])


def simulated_touches(sensor: str, surfaces: int, seed: int) -> Touches:
    """Press random surfaces, each once, on the units that a seed draws."""
    units, rows = sensor_units(SENSORS[sensor], seed), []
    if sensor == "digit":
        units = [replace(unit, defocus=_DIGIT_DEFOCUS) for unit in units]
    for i in track(range(surfaces), "surfaces", "surface"):
        rng, unit = np.random.default_rng([seed, 1, i]), units[i % len(units)]
        untouched, pressed = visible_press(random_surface(rng), unit, rng)
        found = _touch(pressed, untouched.astype(np.float32))
        if found is not None:
            again = render_untouched(unit, rng).astype(np.float32) - untouched
            noise = band_powers(again, np.ones(untouched.shape[:2], bool))
            rows.append(np.maximum(found[0] - noise, 0))
    return Touches(np.array(rows), [str(i) for i in range(len(rows))])


def _figures(touches: Touches, simulated: Touches) -> dict[str, Any]:
    """Return medians over touches, with intervals over things, and how far simulation is off."""
    counts, things = np.sqrt(touches.powers), np.array(touches.things)
    median = np.median(counts, 0)
    off = 20 * np.log10(np.median(np.sqrt(simulated.powers), 0) / median)
    return {
        "n": len(counts),
        "things": len(set(touches.things)),
        "median": median.tolist(),
        "intervals": [interval(band, things, lambda v: float(np.median(v))) for band in counts.T],
        "root_mean_square": np.sqrt(touches.powers.mean(0)).tolist(),
        "simulated_db": off.tolist(),
    }


def _table(rows: list[dict[str, Any]]) -> str:
    bands = "".join(f"{f'{band:g} px':>19}" for band in BANDS)
    lines = [
        "root mean square in the contact, counts: median over touches [95 % over things]",
        f"{'sensor':<15}{'touches':<17}{'n':>5}{'things':>7}{bands}",
    ]
    for row in rows:
        cells = "".join(
            f"{f'{median:.2f} [{low:.2f}, {high:.2f}]':>19}"
            for median, (low, high) in zip(row["median"], row["intervals"], strict=True)
        )
        head = f"{row['sensor']:<15}{row['touches']:<17}{row['n']:>5}{row['things']:>7}"
        lines.append(head + cells)
        if row["touches"] != "simulated":
            lines.append(
                f"{'  simulated less real, dB':<44}"
                + "".join(f"{decibel:>+19.1f}" for decibel in row["simulated_db"])
            )
    return "\n".join(lines)


def _plot(rows: list[dict[str, Any]]) -> Image:
    """Draw the spectra of each sensor, RGB."""
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    sensors = list(dict.fromkeys(row["sensor"] for row in rows))
    for axes, sensor in zip(figure.subplots(1, len(sensors), sharey=True), sensors, strict=True):
        for row in (r for r in rows if r["sensor"] == sensor):
            low, high = np.transpose(row["intervals"])
            [line] = axes.loglog(BANDS, row["median"], "o-", label=f"{row['touches']} ({row['n']})")
            axes.fill_between(BANDS, low, high, color=line.get_color(), alpha=0.15, lw=0)
        axes.set(title=sensor, xlabel="size of the detail, px", xticks=BANDS)
        axes.set_xticklabels([f"{band:g}" for band in BANDS])
        axes.set(yticks=_TICKS, ylim=(_TICKS[0], _TICKS[-1]))
        axes.set_yticklabels([f"{tick:g}" for tick in _TICKS])
        axes.minorticks_off()
        axes.legend(frameon=False)
    figure.axes[0].set_ylabel("change in the contact, counts")
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
