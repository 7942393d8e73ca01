"""Bent wires for the bead maze: five families, three disjoint splits, made from seeds.

A wire of constant length is integrated from heading and pitch (rad) over arc length (m).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError

Family = Literal["fourier", "roller", "helix", "arc", "serpentine"]
Split = Literal["training", "validation", "test"]
FAMILIES: tuple[Family, ...] = get_args(Family)
HELD_OUT: Family = "serpentine"  # never trained on
TRAINED: tuple[Family, ...] = tuple(f for f in FAMILIES if f != HELD_OUT)

LENGTH = 0.40  # m
STEP = 0.0005  # m of arc between points
MIN_RADIUS = 0.035  # m: on a tighter bend the 16 mm long bead binds in its clearance
MAX_SLOPE = 0.6  # rad: a hand aligned with a steeper wire leaves the FR3's comfortable range
MAX_TURN = 1.6  # rad of heading to either side of the wire's main direction, for the same reason
CLEARANCE = 0.055  # m between parts of a wire, so that the fingers (29 mm) pass
APART = 0.005  # m: closer than this (`distance`), two wires count as one

_S = np.arange(0.0, LENGTH + STEP / 2, STEP)
# Test and validation wires are chosen first, so that training wires like them are left out.
PER_FAMILY: dict[Split, int] = {"test": 50, "validation": 20, "training": 1000}


@dataclass(frozen=True, eq=False)
class Wire:
    """A bent wire.

    As made, its main direction is +y, the middle of its bounding box lies above the origin, and
    its lowest point at z = 0.
    """

    family: Family
    seed: int
    points: Float[np.ndarray, "n 3"]  # every `STEP` m of arc, from the end where the bead starts

    @property
    def name(self) -> str:
        """Name such as helix-1, for `find`."""
        return f"{self.family}-{self.seed}"

    @cached_property
    def tangents(self) -> Float[np.ndarray, "n 3"]:
        """Unit vectors along the wire."""
        t = np.gradient(self.points, STEP, axis=0)
        return t / np.linalg.norm(t, axis=1, keepdims=True)

    def at(self, s: float) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Return point and unit tangent after `s` m of arc; clipped at the ends."""
        k = min(max(s, 0.0), LENGTH) / STEP
        i = min(int(k), len(self.points) - 2)
        a = k - i
        tangent = (1 - a) * self.tangents[i] + a * self.tangents[i + 1]
        point = (1 - a) * self.points[i] + a * self.points[i + 1]
        return point, tangent / np.linalg.norm(tangent)

    def project(self, position: Float[np.ndarray, "3"], s: float) -> float:
        """Return the arc length (m) of the point nearest to a position, near the arc length `s`."""
        for _ in range(3):  # Newton; curvature times distance is below a tenth
            point, tangent = self.at(s)
            s = min(max(s + float((position - point) @ tangent), 0.0), LENGTH)
        return s

    def moved(self, position: Float[np.ndarray, "3"], yaw: float) -> "Wire":
        """Return the wire turned by `yaw` about the vertical, then shifted."""
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return replace(self, points=self.points @ turn.T + position)

    def chords(self, sag: float, longest: float) -> Float[np.ndarray, "m 2 3"]:
        """Return ends of straight pieces, at most `longest` m, within `sag` m of the wire."""
        lengths = np.minimum(np.sqrt(8 * sag / np.maximum(self.curvature, 1e-3)), longest)
        pieces = np.cumsum(STEP / lengths)  # how many pieces end before each point
        count = int(np.ceil(pieces[-1]))
        at = np.interp(np.linspace(0, pieces[-1], count + 1), pieces, np.arange(len(pieces)))
        corners = self.points[np.round(at).astype(int)]
        return np.stack([corners[:-1], corners[1:]], axis=1)

    @cached_property
    def curvature(self) -> Float[np.ndarray, " n"]:
        """1/m at each point."""
        return np.linalg.norm(np.gradient(self.tangents, STEP, axis=0), axis=1)

    @property
    def min_radius(self) -> float:
        """Smallest radius of curvature, m; the differences at the ends do not count."""
        return float(1 / max(self.curvature[2:-2].max(), 1e-9))

    @property
    def clearance(self) -> float:
        """Least distance between parts at least 85 mm of arc apart, m."""
        points, apart = self.points[::20], np.abs(_S[::20, None] - _S[None, ::20]) > 0.085
        return float(np.linalg.norm(points[:, None] - points[None], axis=2)[apart].min())


def make(family: Family, seed: int) -> Wire | None:
    """Make the wire of a family and a seed; None if too tight, too steep or close to itself."""
    heading, pitch = _FAMILIES[family](np.random.default_rng([FAMILIES.index(family), seed]))
    heading = heading - 0.5 * (heading.min() + heading.max())
    if np.abs(pitch).max() > MAX_SLOPE or heading.max() > MAX_TURN:
        return None
    flat = np.cos(pitch)
    tangents = np.stack([-flat * np.sin(heading), flat * np.cos(heading), np.sin(pitch)], axis=1)
    steps = 0.5 * STEP * (tangents[1:] + tangents[:-1])
    points = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    points -= 0.5 * (points.min(axis=0) + points.max(axis=0))
    points[:, 2] -= points[:, 2].min()
    wire = Wire(family, seed, points)
    return wire if wire.min_radius > MIN_RADIUS and wire.clearance > CLEARANCE else None


def find_wire(name: str) -> Wire:
    """Return the wire of a name such as helix-1; UserError if there is none."""
    family, _, seed = name.rpartition("-")
    if family not in FAMILIES or not seed.isdecimal():
        raise UserError(
            f"unknown wire {name!r}; a wire is FAMILY-SEED with a family of: {', '.join(FAMILIES)}"
        )
    wire = make(family, int(seed))
    if wire is None:
        raise UserError(f"the seed of {name!r} makes no sound wire; take another")
    return wire


def choose(split: Split, count: int, families: tuple[Family, ...] = TRAINED) -> list[Wire]:
    """Return the first `count` wires of a split, families in turn; fewer are a prefix of more.

    Within a family no two wires of any split are closer than `APART`.
    """
    each = -(-count // len(families))
    if each > PER_FAMILY[split]:
        raise UserError(
            f"there are {PER_FAMILY[split]} {split} wires per family; ask for fewer than {each}"
        )
    rows = zip(*(_distinct(family, split, each) for family in families), strict=True)
    return [wire for row in rows for wire in row][:count]


@lru_cache(maxsize=64)
def _distinct(family: Family, split: Split, count: int) -> tuple[Wire, ...]:
    """Return the first valid wires of a split that resemble none before them."""
    before: list[Wire] = []
    for earlier in ("test", "validation"):
        if earlier == split:
            break
        before += _distinct(family, earlier, PER_FAMILY[earlier])
    shapes = [shape(wire) for wire in before]
    wires: list[Wire] = []
    for seed in seeds.WIRES[split]:
        if len(wires) == count:
            break
        wire = make(family, seed)
        if wire is not None and (not shapes or distance(shape(wire), np.stack(shapes)) > APART):
            wires.append(wire)
            shapes.append(shape(wire))
    return tuple(wires)


def shape(wire: Wire) -> Float[np.ndarray, "n 3"]:
    """Return 41 points of a wire about their centroid, for `distance`."""
    points = wire.points[::20]
    return points - points.mean(axis=0)


def distance(one: Float[np.ndarray, "n 3"], others: Float[np.ndarray, "m n 3"]) -> float:
    """Return the RMS point distance (m) to the nearest other wire, best turned about z."""
    a, b = one[:, 0] + 1j * one[:, 1], others[..., 0] + 1j * others[..., 1]
    # The best turn makes the sum of conj(a) b real and positive.
    flat = np.mean(np.abs(a) ** 2) + np.mean(np.abs(b) ** 2, axis=1)
    flat -= 2 * np.abs(np.mean(a.conj() * b, axis=1))
    rise = np.mean((one[:, 2] - others[..., 2]) ** 2, axis=1)
    return float(np.sqrt(np.maximum(flat + rise, 0).min()))


# Heading and pitch (rad) over arc length, of each family.

_Angles = tuple[np.ndarray, np.ndarray]


def _fourier(rng: np.random.Generator) -> _Angles:
    heading = STEP * np.cumsum(_noise(rng, 0.05, 0.9 / MIN_RADIUS))
    heading *= min(1.0, 2.4 / np.ptp(heading))
    return heading, _noise(rng, 0.08, rng.uniform(0.2, 0.5))


def _roller(rng: np.random.Generator) -> _Angles:
    wave, _ = _wave(rng, 0.11, 0.22)
    return _noise(rng, 0.10, rng.uniform(0.2, 0.8)), rng.uniform(0.35, 0.55) * wave


def _helix(rng: np.random.Generator) -> _Angles:
    turn, spiral = rng.choice([-1, 1]) * rng.uniform(1.6, 3.0), rng.uniform(-0.6, 0.6)
    u = _S / LENGTH
    heading = turn * (u + spiral * u * (1 - u)) + _noise(rng, 0.15, rng.uniform(0.0, 0.2))
    climb = rng.choice([-1, 1]) * rng.uniform(0.1, 0.4)
    return heading, climb + _noise(rng, 0.10, rng.uniform(0.05, 0.2))


def _arc(rng: np.random.Generator) -> _Angles:
    """Bend a straight line once or twice, circularly, in a tilted plane."""
    heading = np.zeros_like(_S)
    knots = np.sort(rng.uniform(0.05, LENGTH - 0.05, 4))
    for start, end in (knots[:2], knots[2:]):
        angle = min(rng.uniform(0.4, 1.8), 0.9 * (end - start) / MIN_RADIUS)
        heading += rng.choice([-1, 1]) * angle * _ramp((_S - start) / (end - start))
    middle = 0.5 * (heading.min() + heading.max())
    tilt, towards = rng.uniform(-0.35, 0.35), rng.uniform(-1.0, 1.0)
    return heading, np.arctan(np.tan(tilt) * np.cos(heading - middle - towards))


def _serpentine(rng: np.random.Generator) -> _Angles:
    wave, k = _wave(rng, 0.10, 0.20)
    return rng.uniform(0.7, 0.95) / (k * MIN_RADIUS) * wave, _noise(rng, 0.08, 0.3)


_FAMILIES: dict[Family, Callable[[np.random.Generator], _Angles]] = {
    "fourier": _fourier,
    "roller": _roller,
    "helix": _helix,
    "arc": _arc,
    "serpentine": _serpentine,
}


def _noise(rng: np.random.Generator, shortest: float, amplitude: float) -> np.ndarray:
    """Draw a smooth function of waves of at least `shortest` m, with maximum `amplitude`."""
    total = np.zeros_like(_S)
    for k in range(1, int(LENGTH / shortest) + 1):
        wave = np.sin(np.pi * k * _S / LENGTH + rng.uniform(0, 2 * np.pi))
        total += rng.normal() / np.sqrt(k) * wave
    return amplitude * total / np.abs(total).max()


def _wave(rng: np.random.Generator, shortest: float, longest: float) -> tuple[np.ndarray, float]:
    """Draw a sine of random phase and wavelength (m); return it with its wave number (rad/m)."""
    k = 2 * np.pi / rng.uniform(shortest, longest)
    return np.sin(k * _S + rng.uniform(0, 2 * np.pi)), k


def _ramp(u: np.ndarray) -> np.ndarray:
    """Ramp from 0 to 1 with rounded corners, for bends without kinks."""
    sharp = np.clip(u, 0, 1)
    width = 24  # points, 12 mm of arc
    padded = np.pad(sharp, width, mode="edge")
    return np.convolve(padded, np.hanning(2 * width + 1) / width, mode="valid")
