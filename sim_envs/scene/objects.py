"""Objects to grasp: shapes, materials, and the catalogue of both."""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Literal

import numpy as np
from jaxtyping import Float

from touchgoal.runtime.errors import UserError

Shape = Literal["box", "cylinder", "sphere", "capsule", "mesh"]
SHAPES: tuple[Shape, ...] = ("box", "cylinder", "sphere", "capsule", "mesh")


class Texture(IntEnum):
    """Height pattern on a surface; `sim_envs/tactile/geometry.py` evaluates it."""

    SMOOTH = 0
    RIBBED = 1
    DOTTED = 2
    ROUGH = 3
    WOVEN = 4


@dataclass(frozen=True)
class Material:
    """How a surface feels.

    Attributes:
        texture: its pattern.
        amplitude: of the pattern, half of peak to peak, m.
        wavelength: of the pattern, m.
        foundation_modulus: pressure per indentation, Pa/m; the gel's own is 3e8.
        friction: sliding friction coefficient against gel and table.
        rgba: colour.
    """

    texture: Texture
    amplitude: float
    wavelength: float
    foundation_modulus: float
    friction: float
    rgba: tuple[float, float, float, float]


HARD, FIRM, SOFT = 1e11, 6e8, 1.2e8  # Pa/m: far stiffer than the gel, twice as stiff, softer


@dataclass(frozen=True)
class ObjectKind:
    """One entry of the catalogue; `descriptions` say in different words how it feels."""

    name: str
    shape: Shape
    material: Material
    descriptions: tuple[str, ...]


@dataclass(frozen=True)
class Body:
    """One object to put into a scene.

    Attributes:
        kind: what it is.
        size: half extents as MuJoCo takes them (box: xyz; cylinder and capsule: radius, half
            length; sphere: radius; mesh: scale of the unit hull), m.
        mass: kg.
    """

    kind: ObjectKind
    size: tuple[float, ...]
    mass: float
    name: str = "object"
    hull: Float[np.ndarray, "n 3"] | None = field(default=None, compare=False)

    @property
    def rest_height(self) -> float:
        """Height of the centre above the table, lying as it is spawned, m."""
        if self.kind.shape == "box":
            return self.size[2]
        if self.kind.shape == "cylinder":
            return self.size[1]
        if self.kind.shape == "mesh":
            assert self.hull is not None
            return float(-self.hull[:, 2].min())
        return self.size[0]


def _kind(name: str, shape: Shape, material: Material, *descriptions: str) -> ObjectKind:
    return ObjectKind(name, shape, material, descriptions)


def _material(
    texture: Texture,
    amplitude_um: float,
    wavelength_mm: float,
    modulus: float,
    friction: float,
    r: float,
    g: float,
    b: float,
) -> Material:
    return Material(
        texture, amplitude_um * 1e-6, wavelength_mm * 1e-3, modulus, friction, (r, g, b, 1.0)
    )


_S, _RI, _D, _RO, _W = Texture.SMOOTH, Texture.RIBBED, Texture.DOTTED, Texture.ROUGH, Texture.WOVEN

# Each shows in touch: no smooth flat face here, for one larger than the gel presses it evenly, and a
# GelSight, which sees slopes, shows nothing.
CATALOGUE: dict[str, ObjectKind] = {
    kind.name: kind
    for kind in (
        _kind(
            "glass_ball",
            "sphere",
            _material(_S, 0.0, 1.0, HARD, 0.6, 0.45, 0.75, 0.85),
            "a hard smooth round ball of glass",
            "hard, smooth and perfectly round",
            "a smooth hard sphere without any texture",
            "something round that is hard and slick",
        ),
        _kind(
            "golf_ball",
            "sphere",
            _material(_D, 70.0, 3.2, HARD, 0.7, 0.95, 0.95, 0.92),
            "a hard round ball covered with dimples",
            "round and hard with a dotted, dimpled surface",
            "a firm dimpled sphere",
            "a hard ball with regular bumps and pits",
        ),
        _kind(
            "foam_ball",
            "sphere",
            _material(_RO, 60.0, 1.6, SOFT, 0.9, 0.95, 0.55, 0.2),
            "a soft round ball of rough foam",
            "soft, squishy and round with a grainy surface",
            "a squishy rough sphere",
            "a round soft sponge-like ball",
        ),
        _kind(
            "yarn_ball",
            "sphere",
            _material(_W, 70.0, 2.2, FIRM, 0.9, 0.75, 0.3, 0.45),
            "a round ball of wound yarn",
            "woven threads wrapped into a firm ball",
            "a round fabric ball that gives a little",
            "a sphere with a woven, textile feel",
        ),
        _kind(
            "wooden_block",
            "box",
            _material(_RI, 35.0, 1.4, HARD, 0.7, 0.72, 0.53, 0.33),
            "a hard flat block with fine wood grain ridges",
            "flat, hard and finely ribbed like wood",
            "a hard box with parallel ridges",
            "a flat wooden face with grooves",
        ),
        _kind(
            "brick",
            "box",
            _material(_RO, 80.0, 1.4, HARD, 0.9, 0.7, 0.28, 0.2),
            "a hard rough flat brick",
            "flat and hard with a sandy, gritty surface",
            "a coarse stony block",
            "a rough flat face that does not give",
        ),
        _kind(
            "cushion",
            "box",
            _material(_W, 90.0, 2.4, SOFT, 1.0, 0.93, 0.6, 0.68),
            "a soft flat cushion of woven cloth",
            "flat and soft with a textile weave",
            "a squishy pad covered in fabric",
            "a soft woven flat face",
        ),
        _kind(
            "toy_brick",
            "box",
            _material(_D, 90.0, 4.0, HARD, 0.6, 0.2, 0.4, 0.85),
            "a hard flat plastic brick with studs",
            "flat and hard with rows of raised dots",
            "a plastic block with a regular pattern of bumps",
            "a studded flat face",
        ),
        _kind(
            "soda_can",
            "cylinder",
            _material(_S, 0.0, 1.0, HARD, 0.55, 0.8, 0.82, 0.85),
            "a hard smooth metal can, curved one way",
            "smooth, hard and cylindrical",
            "a slick hard tube standing upright",
            "a smooth cylinder of metal",
        ),
        _kind(
            "bottle_cap",
            "cylinder",
            _material(_RI, 90.0, 2.0, HARD, 0.8, 0.15, 0.6, 0.35),
            "a hard cylinder with ridges for grip",
            "a ribbed hard cap, curved with parallel ridges",
            "hard and round on the side with grooves",
            "a grooved cylinder",
        ),
        _kind(
            "rope_coil",
            "cylinder",
            _material(_W, 85.0, 2.6, FIRM, 0.9, 0.75, 0.65, 0.42),
            "a firm cylinder of woven rope",
            "woven strands around a curved side",
            "a roll of braided cord that gives a little",
            "a cylinder with a textile weave",
        ),
        _kind(
            "cork",
            "cylinder",
            _material(_RO, 55.0, 1.8, FIRM, 0.8, 0.82, 0.67, 0.48),
            "a firm cork with a grainy curved side",
            "a slightly rough cylinder that yields a little",
            "a grainy, firm, curved stopper",
            "a cylinder with small irregular pits",
        ),
        _kind(
            "candle",
            "capsule",
            _material(_S, 0.0, 1.0, FIRM, 0.65, 0.96, 0.93, 0.8),
            "a firm smooth waxy rod with rounded ends",
            "smooth and waxy, long and rounded",
            "a smooth firm bar, curved across",
            "a waxy smooth stick",
        ),
        _kind(
            "corn_cob",
            "capsule",
            _material(_D, 85.0, 3.6, FIRM, 0.8, 0.95, 0.8, 0.25),
            "a firm cob with rows of bumps",
            "long and rounded, covered with kernels",
            "a bumpy firm rod",
            "rows of raised dots along a rounded bar",
        ),
        _kind(
            "sausage",
            "capsule",
            _material(_S, 0.0, 1.0, SOFT, 0.8, 0.65, 0.3, 0.25),
            "a soft smooth sausage",
            "smooth, soft and long",
            "a squishy rounded rod with a smooth skin",
            "a soft tube that gives way easily",
        ),
        _kind(
            "brush_handle",
            "capsule",
            _material(_RI, 80.0, 2.6, HARD, 0.8, 0.1, 0.1, 0.12),
            "a hard handle with grip ribs",
            "hard, long and ribbed",
            "a rounded bar with parallel ridges",
            "a grooved hard handle",
        ),
        _kind(
            "pebble",
            "mesh",
            _material(_S, 0.0, 1.0, HARD, 0.7, 0.5, 0.5, 0.55),
            "a hard smooth stone with facets",
            "smooth, hard and irregular with edges",
            "a faceted pebble",
            "a hard uneven lump with flat smooth faces",
        ),
        _kind(
            "walnut",
            "mesh",
            _material(_RO, 90.0, 2.4, HARD, 0.85, 0.55, 0.38, 0.22),
            "a hard rough nut with an irregular shape",
            "hard, wrinkled and uneven",
            "a coarse irregular shell",
            "a rough hard lump with edges",
        ),
        _kind(
            "clay_lump",
            "mesh",
            _material(_S, 0.0, 1.0, SOFT, 0.9, 0.62, 0.42, 0.32),
            "a soft smooth lump of clay",
            "soft and irregular with smooth faces",
            "a squishy uneven lump",
            "smooth clay that gives way",
        ),
        _kind(
            "rag_bundle",
            "mesh",
            _material(_W, 80.0, 2.4, SOFT, 1.0, 0.35, 0.5, 0.7),
            "a soft bundle of woven cloth",
            "soft, woven and irregular",
            "crumpled fabric that gives way",
            "a squishy lump with a textile weave",
        ),
    )
}

# Ranges of half extents, m: what the hand can span (8 cm) and the case can get around on a table.
_SIZES: dict[Shape, tuple[tuple[float, float], ...]] = {
    "box": ((0.015, 0.028), (0.014, 0.028), (0.022, 0.035)),
    "cylinder": ((0.014, 0.028), (0.022, 0.038)),
    "sphere": ((0.021, 0.030),),
    "capsule": ((0.018, 0.022), (0.020, 0.035)),
    "mesh": ((0.022, 0.028),),
}


def find(name: str) -> ObjectKind:
    """The catalogue's entry; UserError lists what there is."""
    if name not in CATALOGUE:
        raise UserError(f"unknown object {name!r}; choose from: {', '.join(CATALOGUE)}")
    return CATALOGUE[name]


def sample_body(
    kind: ObjectKind, rng: np.random.Generator, mass: float, name: str = "object"
) -> Body:
    """An object of this kind with a random size; meshes also get a random convex hull."""
    size = tuple(float(rng.uniform(*bounds)) for bounds in _SIZES[kind.shape])
    hull = size[0] * _unit_hull(rng) if kind.shape == "mesh" else None
    return Body(kind, size, mass, name, hull)


def _unit_hull(rng: np.random.Generator, n: int = 24) -> Float[np.ndarray, "n 3"]:
    """Points near the unit sphere, the shape of a stone."""
    points = rng.normal(size=(n, 3))
    points *= rng.uniform(0.85, 1.0, (n, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    return points * (1.0, 1.0, 1.1)
