"""Twenty cloths pressed into a fingertip sensor by hand, for TacBench T6 (textile).

Every clip is one press that deepens and drifts; each has its own piece of cloth and body.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from benchmarks.papers.tacbench_rig.config import RigConfig, rig_unit
from touchgoal.sim_envs.tactile.optics import render_untouched
from touchgoal.sim_envs.tactile.rig.surface_press import SurfacePose, press
from touchgoal.sim_envs.tactile.rig.surfaces import TILE, Surface

FRAMES = 5  # frames of a clip; the first is untouched
_UNEVEN = 0.1  # share of the relief that is fuzz and slubs
_YARN = 0.06  # largest relative difference of yarn between pieces of a cloth
_DEPTHS = (0.3e-3, 1.0e-3)  # m, at the end of a press
_DRIFT = 0.15e-3  # m from one frame to the next, standard deviation

Tile = Float32[np.ndarray, "256 256"]
Pattern = Callable[[Tile, Tile], Tile]
"""Height from 0 to 1 over places counted in yarns along and across."""


@dataclass(frozen=True)
class Cloth:
    """One kind of cloth."""

    name: str
    yarns: tuple[int, int]  # along and across the 25.6 mm of a tile
    relief: float  # from the lowest to the highest point, m
    pattern: Pattern  # how its yarns lie
    fuzz: float = 0.0  # share of the relief that is loose fibre


@dataclass(frozen=True, eq=False)
class ClothClip:
    """Frames of one press, RGB, the first untouched, and the cloth's number in `CLOTHS`."""

    frames: UInt8[np.ndarray, "t h w 3"]
    cloth: int


def press_cloth(config: RigConfig, index: int) -> ClothClip:
    """Simulate one clip; the same config and index always give the same one."""
    rng, unit = np.random.default_rng([config.seed, index, 4]), rig_unit(config)
    number = index % len(CLOTHS)
    surface = _piece(CLOTHS[number], rng)
    last = float(np.exp(rng.uniform(*np.log(_DEPTHS))))
    turn, tilt = float(rng.uniform(0, 2 * np.pi)), rng.normal(0, 0.01, 2)
    place, on_cloth = rng.normal(0, 1.5e-3, 2), rng.uniform(0, TILE, 2)
    # dots at rest: a press without shear hardly moves them
    frames = [unit.with_dots(render_untouched(unit, rng))]
    for depth in np.linspace(0.4, 1.0, FRAMES - 1) * last:
        place = place + rng.normal(0, _DRIFT, 2)
        pose = SurfacePose(
            (float(place[0]), float(place[1])),
            turn,
            (float(tilt[0]), float(tilt[1])),
            (float(on_cloth[0]), float(on_cloth[1])),
            float(depth),
        )
        frames.append(press(surface, pose, unit, rng))
    return ClothClip(np.stack(frames), number)


def _piece(cloth: Cloth, rng: np.random.Generator) -> Surface:
    pattern = _height(cloth, rng)
    relief = cloth.relief * rng.uniform(0.85, 1.15)
    body = "flat" if rng.random() < 0.5 else "cylinder"
    size = float(rng.uniform(10e-3, 30e-3))
    firmness = float(rng.uniform(0.5, 1.0))
    return Surface(body, size, 0.0, (relief * pattern).astype(np.float32), firmness)


def _height(cloth: Cloth, rng: np.random.Generator) -> Tile:
    """Draw one piece's height, 0 to about 1; pieces differ in the number and course of yarns."""
    along, across = (max(2, round(n * (1 + _YARN * rng.uniform(-1, 1)))) for n in cloth.yarns)
    y, x = np.mgrid[:TILE, :TILE].astype(np.float32) / TILE
    bend = 0.15 * _noise(rng, 40), 0.15 * _noise(rng, 40)
    height = cloth.pattern(along * x + bend[0], across * y + bend[1]).astype(np.float32)
    fuzz = max(cloth.fuzz, _UNEVEN)
    return (1 - cloth.fuzz) * height + np.float32(fuzz) * _noise(rng, 2.5)


def _noise(rng: np.random.Generator, cells: float) -> Tile:
    """Draw smooth noise without seams, of standard deviation 1."""
    white = rng.normal(size=(TILE, TILE)).astype(np.float32)
    wrapped = cv2.copyMakeBorder(white, 128, 128, 128, 128, cv2.BORDER_WRAP)
    smooth = cv2.GaussianBlur(wrapped, (0, 0), cells)[128:-128, 128:-128]
    return smooth / smooth.std()


def _round(phase: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(1 - (2 * (phase % 1) - 1) ** 2, 0))


def _woven(over: int, under: int, step: int, bundle: int = 1, turn_after: int = 0) -> Pattern:
    """Return a weave: warp over `over` wefts, under `under`; each row shifted by `step`."""

    def height(u: Tile, v: Tile) -> Tile:
        i, j = np.floor(u / bundle).astype(int), np.floor(v / bundle).astype(int)
        if turn_after:
            i = np.where((i // turn_after) % 2 == 0, i, -i)
        up = (j + step * i) % (over + under) < over
        warp, weft = _round(u), _round(v)
        return np.where(up, np.maximum(warp, 0.5 * weft), np.maximum(weft, 0.5 * warp))

    return height


def _jersey(u: Tile, v: Tile) -> Tile:
    fold = np.abs(u % 1 - 0.5)
    return np.sqrt(np.abs(np.sin(np.pi * (v + 1.2 * fold)))) * (0.4 + 0.6 * _round(2 * u))


def _ribs(share: float) -> Pattern:
    return lambda u, v: _round(np.minimum((u % 1) / share, 1)) + 0 * v


def _rib_knit(u: Tile, v: Tile) -> Tile:
    raised = (np.floor(u / 2) % 2).astype(np.float32)
    return 0.45 * raised + 0.55 * _jersey(u, v)


def _waffle(u: Tile, v: Tile) -> Tile:
    wall = np.maximum(np.abs(u % 1 - 0.5), np.abs(v % 1 - 0.5)) * 2
    return wall**2


def _mesh(u: Tile, v: Tile) -> Tile:
    shifted = u + 0.5 * (np.floor(v) % 2)
    return np.minimum(np.hypot(shifted % 1 - 0.5, v % 1 - 0.5) * 2.2, 1)


def _loops(u: Tile, v: Tile) -> Tile:
    wander = v + 0.3 * np.sin(2.1 * np.floor(u))
    return _round(u) * _round(wander)


def _quilt(u: Tile, v: Tile) -> Tile:
    return np.sqrt(np.abs(np.sin(np.pi * (u + v)) * np.sin(np.pi * (u - v))))


CLOTHS: tuple[Cloth, ...] = (
    Cloth("poplin", (64, 50), 40e-6, _woven(1, 1, 1)),
    Cloth("canvas", (30, 26), 110e-6, _woven(1, 1, 1)),
    Cloth("burlap", (16, 15), 260e-6, _woven(1, 1, 1), fuzz=0.2),
    Cloth("basket", (44, 40), 120e-6, _woven(1, 1, 1, bundle=2)),
    Cloth("drill", (40, 36), 90e-6, _woven(2, 1, 1)),
    Cloth("denim", (32, 24), 150e-6, _woven(3, 1, 1)),
    Cloth("herringbone", (36, 36), 110e-6, _woven(2, 2, 1, turn_after=6)),
    Cloth("satin", (56, 44), 50e-6, _woven(7, 1, 3)),
    Cloth("jersey", (26, 34), 110e-6, _jersey),
    Cloth("chunky knit", (9, 12), 420e-6, _jersey),
    Cloth("purl", (20, 26), 170e-6, lambda u, v: _round(v + 0.25 * np.sin(2 * np.pi * u))),
    Cloth("rib knit", (18, 26), 280e-6, _rib_knit),
    Cloth("corduroy", (10, 10), 380e-6, _ribs(0.8), fuzz=0.15),
    Cloth("needlecord", (22, 22), 180e-6, _ribs(0.8), fuzz=0.15),
    Cloth("ottoman", (13, 13), 200e-6, lambda u, v: 0.8 * _round(v) + 0.2 * _round(5 * u)),
    Cloth("waffle", (6, 6), 420e-6, _waffle),
    Cloth("mesh", (14, 14), 260e-6, _mesh),
    Cloth("terry", (14, 18), 380e-6, _loops, fuzz=0.35),
    Cloth("felt", (8, 8), 130e-6, lambda u, v: np.full_like(u + v, 0.5), fuzz=0.8),
    Cloth("quilt", (4, 4), 450e-6, _quilt),
)
