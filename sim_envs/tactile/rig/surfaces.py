"""Random surfaces: bodies (flat, round, edged) with textures as height maps in metres.

Textures are tiles that repeat; a press takes them anywhere, at any angle (`surface_press`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float32

TILE = 512  # cells along a texture's side
TILE_PITCH = 0.05e-3  # m per cell of a texture, less than a pixel: a tile shows 25.6 mm

Tile = Float32[np.ndarray, "512 512"]
Body = Literal["flat", "ball", "cylinder", "edge", "bar", "corner"]
BODIES: tuple[Body, ...] = ("flat", "ball", "cylinder", "edge", "bar", "corner")


# The body's shares in the order of `BODIES`, and its sizes, m.
_SHARES, _SIZES = (0.38, 0.26, 0.12, 0.09, 0.09, 0.06), (2.5e-3, 60e-3)
# Textures are drawn by their slope: a gel follows a wave of height a and length l only under a
# pressure that grows as a / l (Johnson, Contact Mechanics, 13.2), so under one hand the slope is
# limited, not the height. These ranges (m per m) and shares were chosen so that simulated presses
# have the spectrum of real ones (`python -m benchmarks touch-spectrum`).
_GRAIN, _SLOPES = (0.09, 0.28), (0.14, 0.7)
_LAYERS = (0.15, 0.45, 0.4)  # shares of surfaces with none, one and two patterns on their grain
_HIGHEST = 0.8e-3  # m: a coarse pattern needs not be steep
_COAT = 2.0  # cells: the gel's coat and the camera blur what is finer


@dataclass(frozen=True)
class Surface:
    """One body with a texture."""

    body: Body  # its coarse shape where it meets the gel
    size: float  # radius of a ball or cylinder, half a bar's width, m; else unused
    slope: float  # slope beside an edge, bar or corner, m per m
    texture: Tile  # height added to the body, m
    firmness: float  # share of the overlap that indents the gel; the object takes the rest


def random_surface(rng: np.random.Generator) -> Surface:
    """Draw a surface."""
    texture = _steep(_grain(rng), _log_uniform(rng, *_GRAIN))
    for _ in range(int(rng.choice([0, 1, 2], p=_LAYERS))):
        pattern = _PATTERNS[rng.integers(len(_PATTERNS))](rng)
        texture += _steep(pattern, _log_uniform(rng, *_SLOPES))
    texture = cv2.GaussianBlur(np.pad(texture, 8, mode="wrap"), (0, 0), _COAT)[8:-8, 8:-8]
    return Surface(
        body=BODIES[rng.choice(len(BODIES), p=_SHARES)],
        size=_log_uniform(rng, *_SIZES),
        slope=_log_uniform(rng, 0.1, 2.0),
        texture=np.ascontiguousarray(texture),
        firmness=float(rng.choice([1.0, rng.uniform(0.15, 1.0)])),
    )


def _log_uniform(rng: np.random.Generator, least: float, most: float) -> float:
    return float(np.exp(rng.uniform(np.log(least), np.log(most))))


def _steep(tile: Tile, slope: float) -> Tile:
    """Scale a pattern to a slope (root mean square, m per m), at most `_HIGHEST` high."""
    tile = _unit(tile)
    along, across = tile - np.roll(tile, 1, 0), tile - np.roll(tile, 1, 1)
    steepness = float(np.sqrt((along**2 + across**2).mean())) / TILE_PITCH
    return tile * np.float32(min(slope / steepness, _HIGHEST))


def _unit(tile: Tile) -> Tile:
    """Normalise to a mean of 0 and a range of about 1."""
    low, high = np.percentile(tile[::4, ::4], [1, 99])
    return ((tile - tile.mean()) / max(float(high - low), 1e-6)).astype(np.float32)


def _noise(rng: np.random.Generator, wavelength: float, octaves: float, falloff: float) -> Tile:
    """Draw noise from a wavelength (cells) down over some octaves of falling amplitude."""
    f = np.hypot(np.fft.fftfreq(TILE)[:, None], np.fft.rfftfreq(TILE)[None]).astype(np.float32)
    low, high = 1 / wavelength, 2**octaves / wavelength
    band = np.where((f >= low) & (f <= high), np.maximum(f, 1e-4) ** -falloff, 0)
    if not band.any():
        band = np.exp(-((f - low) ** 2) / (0.1 * low) ** 2)
    phase = np.exp(2j * np.pi * rng.random(band.shape, np.float32))
    return np.fft.irfft2(band * phase, (TILE, TILE)).astype(np.float32)


def _grain(rng: np.random.Generator) -> Tile:
    """Draw what every real surface has: unevenness down to 6 cells, and scratches."""
    longest = _log_uniform(rng, 60, 200)
    uneven = _unit(_noise(rng, longest, np.log2(longest / 6), rng.uniform(1.8, 2.2)))
    return uneven + np.float32(rng.uniform(0, 1)) * _unit(_scratches(rng))


def _scratches(rng: np.random.Generator) -> Tile:
    tile = np.zeros((TILE, TILE), np.float32)
    for _ in range(int(rng.integers(1, 25))):
        ends = rng.integers(0, TILE, (2, 2))
        reach = ends[0] + (ends[1] - ends[0]) * rng.uniform(0.1, 1)
        height = float(rng.choice([-1, 1]) * rng.uniform(0.2, 1))
        cv2.line(tile, ends[0].tolist(), reach.astype(int).tolist(), height, 1, cv2.LINE_AA)
    return _rounded(tile, 2)


def _rough(rng: np.random.Generator) -> Tile:
    return _noise(rng, _log_uniform(rng, 6, 240), rng.uniform(0.7, 4), rng.uniform(0.5, 2.5))


def _wrinkles(rng: np.random.Generator, wavelength: float | None = None) -> Tile:
    wavelength = wavelength or _log_uniform(rng, 20, 200)
    folded = np.abs(_noise(rng, wavelength, rng.uniform(0.3, 2), 1.5))
    return folded * np.float32(rng.choice([-1, 1]))


def _phases(rng: np.random.Generator, wavelength: float | None = None) -> tuple[Tile, Tile]:
    """Draw two crossing phases (rad) with whole numbers of periods a tile, a little uneven."""
    periods = int(TILE / wavelength if wavelength else _log_uniform(rng, 4, 100))
    y, x = np.mgrid[:TILE, :TILE].astype(np.float32) * np.float32(2 * np.pi / TILE)
    uneven = np.float32(rng.uniform(0, 0.8))
    bend = _unit(_noise(rng, 200, 1, 1)) * uneven
    skew = int(rng.integers(-periods, periods + 1)) if rng.random() < 0.3 else 0
    return periods * x + skew * y + bend, periods * y + bend


def _ribs(rng: np.random.Generator) -> Tile:
    a, _ = _phases(rng)
    return np.abs(np.sin(a / 2)) ** np.float32(_log_uniform(rng, 0.3, 8))


def _knurl(rng: np.random.Generator, wavelength: float | None = None) -> Tile:
    a, b = _phases(rng, wavelength)
    return (np.abs(np.sin(a / 2)) * np.abs(np.sin(b / 2))) ** np.float32(_log_uniform(rng, 0.3, 6))


def _weave(rng: np.random.Generator) -> Tile:
    a, b = _phases(rng)
    over = np.sin(a / 2) * np.sin(b / 2) > 0
    return np.where(over, np.abs(np.cos(a / 2)), np.abs(np.cos(b / 2))) ** np.float32(
        _log_uniform(rng, 0.5, 2)
    )


def _grains(rng: np.random.Generator, wavelength: float | None = None) -> Tile:
    tile = np.zeros((TILE, TILE), np.float32)
    length = wavelength / 2 if wavelength else _log_uniform(rng, 4, 60)
    width = length * rng.uniform(0.35, 1)
    count = int(rng.uniform(0.15, 0.8) * TILE**2 / (np.pi * length * width)) + 3
    along = rng.uniform(0, np.pi)
    spread = rng.choice([0.2, np.pi])
    reach = int(length) + 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(np.float32)
    stamps = []
    for turn in along + spread * rng.uniform(-1, 1, 12):
        c, s = np.float32(np.cos(turn)), np.float32(np.sin(turn))
        inside = 1 - ((c * x + s * y) / length) ** 2 - ((c * y - s * x) / width) ** 2
        stamps.append(np.sqrt(np.maximum(inside, 0)))
    for _ in range(min(count, 1500)):
        row, column = rng.integers(0, TILE, 2)
        rows = np.arange(row - reach, row + reach + 1) % TILE
        columns = np.arange(column - reach, column + reach + 1) % TILE
        stamp = stamps[rng.integers(12)] * np.float32(rng.uniform(0.6, 1))
        tile[np.ix_(rows, columns)] = np.maximum(tile[np.ix_(rows, columns)], stamp)
    return tile


def _cells(rng: np.random.Generator, wavelength: float | None = None) -> Tile:
    seeds = np.full((TILE, TILE), 255, np.uint8)
    count = (TILE / wavelength) ** 2 if wavelength else _log_uniform(rng, 12, 1500)
    points = rng.integers(0, TILE, (int(count), 2))
    seeds[points[:, 0], points[:, 1]] = 0
    around = cv2.copyMakeBorder(seeds, 64, 64, 64, 64, cv2.BORDER_WRAP)
    distance = cv2.distanceTransform(around, cv2.DIST_L2, 3)[64:-64, 64:-64]
    return distance * np.float32(rng.choice([-1, 1]))


def _strands(rng: np.random.Generator, wavelength: float | None = None) -> Tile:
    tile = np.zeros((TILE, TILE), np.float32)
    width = int(wavelength / 4 if wavelength else rng.integers(1, 17))
    main = rng.uniform(0, np.pi)
    spread = rng.choice([0.15, 1.5])
    count = 5 * TILE / wavelength if wavelength else _log_uniform(rng, 4, 60)
    for _ in range(int(count)):
        angle = main + spread * rng.normal()
        reach = np.array([np.cos(angle), np.sin(angle)]) * rng.uniform(60, 600)
        middle = rng.uniform(0, TILE, 2)
        ends = [tuple(int(v) for v in middle + sign * reach) for sign in (-1, 1)]
        cv2.line(tile, ends[0], ends[1], float(rng.uniform(0.5, 1)), width, cv2.LINE_AA)
    return _rounded(tile, width) * np.float32(rng.choice([1, 1, -1]))


def _plateaus(rng: np.random.Generator, wavelength: float | None = None) -> Tile:
    tile = np.zeros((TILE, TILE), np.uint8)
    white = 255.0
    count = 4 * TILE / wavelength if wavelength else rng.integers(2, 14)
    for _ in range(int(count)):
        at = tuple(int(v) for v in rng.integers(0, TILE, 2))
        size = wavelength or _log_uniform(rng, 16, 120)
        if rng.random() < 0.3:
            text = "".join(rng.choice(list("ABEKRSXZ0235689"), 3))
            cv2.putText(tile, text, at, cv2.FONT_HERSHEY_SIMPLEX, size / 25, white, 3, cv2.LINE_AA)
        elif rng.random() < 0.5:
            cv2.ellipse(
                tile, (at, (size, size * rng.uniform(0.4, 1)), rng.uniform(0, 180)), white, -1
            )
        else:
            box = cv2.boxPoints((at, (size, size * rng.uniform(0.3, 1)), rng.uniform(0, 180)))
            cv2.fillConvexPoly(tile, box.astype(np.int32), white, cv2.LINE_AA)
    return _rounded(tile.astype(np.float32), rng.uniform(1, 10)) * np.float32(
        rng.choice([1, 1, 1, -1])
    )


def _rounded(tile: Tile, width: float) -> Tile:
    return cv2.GaussianBlur(tile, (0, 0), max(0.4 * width, 0.5))


_PATTERNS: tuple[Callable[[np.random.Generator], Tile], ...] = (
    _rough,
    _rough,
    _wrinkles,
    _ribs,
    _knurl,
    _weave,
    _grains,
    _grains,
    _cells,
    _strands,
    _plateaus,
)


WAVELENGTH = 24
"""Cells from one wrinkle, grain, cell, strand or rib of a `named_tile` to the next, about."""
_NAMED: dict[str, Callable[[np.random.Generator, float | None], Tile]] = {
    "wrinkled": _wrinkles,
    "grained": _grains,
    "cellular": _cells,
    "stranded": _strands,
    "lettered": _plateaus,
    "knurled": _knurl,
}


@cache
def named_tile(name: str) -> Tile:
    """Return the tile of a texture of the object catalogues: heights from about -1 to 1."""
    tile = _unit(_NAMED[name](np.random.default_rng(5), WAVELENGTH))
    return np.ascontiguousarray(np.clip(2 * tile, -1.5, 1.5), np.float32)  # strands are raised
