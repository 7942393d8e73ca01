"""Objects to grasp: shapes, materials, and the catalogue of both."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from touchgoal.runtime.errors import UserError, unknown_name

Shape = Literal["box", "cylinder", "sphere", "capsule", "mesh"]
SHAPES: tuple[Shape, ...] = ("box", "cylinder", "sphere", "capsule", "mesh")


class Texture(IntEnum):
    """Height pattern on a surface; `sim_envs/tactile/texture.py` evaluates it."""

    SMOOTH = 0
    RIBBED = 1
    DOTTED = 2
    ROUGH = 3
    WOVEN = 4
    WRINKLED = 5
    GRAINED = 6
    CELLULAR = 7
    STRANDED = 8
    LETTERED = 9
    KNURLED = 10


@dataclass(frozen=True)
class Material:
    """Touch properties of a surface."""

    texture: Texture  # its pattern
    amplitude: float  # amplitude of the pattern, m
    wavelength: float  # wavelength of the pattern, m
    foundation_modulus: float  # pressure per indentation, Pa/m; the gel's own is 3e8
    friction: float  # sliding friction coefficient against gel and table
    rgba: tuple[float, float, float, float]  # colour

    @property
    def is_textured(self) -> bool:
        """Whether the surface has a pattern that a gel can show."""
        return bool(self.texture and self.amplitude)


HARD, FIRM, SOFT = 1e11, 6e8, 1.2e8  # Pa/m: far stiffer than the gel, twice as stiff, softer


@dataclass(frozen=True)
class ObjectKind:
    """One entry of the catalogue, with descriptions of its touch in different words."""

    name: str
    shape: Shape
    material: Material
    descriptions: tuple[str, ...]
    # vertices of a mesh with one shape, m, see `read_hull`; None: drawn for each body
    hull: Float[np.ndarray, "n 3"] | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Body:
    """One object to put into a scene."""

    kind: ObjectKind  # entry of the catalogue
    # half extents as MuJoCo takes them (box: xyz; cylinder and capsule: radius, half length;
    # sphere: radius; mesh: those of the catalogue's unit hull, or of an own object's bounds), m
    size: tuple[float, ...]
    mass: float  # kg
    name: str = "object"
    hull: Float[np.ndarray, "n 3"] | None = field(default=None, compare=False)

    def scaled(self, size: float, friction: float) -> "Body":
        """Return the body with its size and friction multiplied."""
        material = replace(self.kind.material, friction=friction * self.kind.material.friction)
        return replace(
            self,
            kind=replace(self.kind, material=material),
            size=tuple(size * s for s in self.size),
            hull=None if self.hull is None else size * self.hull,
        )

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


def read_material(entry: Mapping[str, Any]) -> Material:
    """Return the material of a catalogue's entry, which is in um, mm and Pa/m (or hard, firm, soft)."""
    return Material(
        Texture[entry["texture"].upper()],
        entry.get("amplitude", 0.0) * 1e-6,
        entry.get("wavelength", 1.0) * 1e-3,
        {"hard": HARD, "firm": FIRM, "soft": SOFT}.get(entry["stiffness"]) or entry["stiffness"],
        entry["friction"],
        (*entry["rgb"], entry.get("opacity", 1.0)),
    )


def _read_kinds(file: str) -> dict[str, ObjectKind]:
    entries = tomllib.loads(Path(__file__).with_name(file).read_text())
    return {
        name: ObjectKind(name, e["shape"], read_material(e), tuple(e["descriptions"]))
        for name, e in entries.items()
    }


CATALOGUE = _read_kinds("objects.toml")
NEW_KINDS = _read_kinds("new_kinds.toml")
"""Objects that nothing here is trained on: to be named, not drawn."""

# Ranges of half extents, m: within the hand's 8 cm, and tall enough for the sensor cases.
_SIZES: dict[Shape, tuple[tuple[float, float], ...]] = {
    "box": ((0.015, 0.028), (0.014, 0.028), (0.022, 0.035)),
    "cylinder": ((0.014, 0.028), (0.022, 0.038)),
    "sphere": ((0.021, 0.030),),
    "capsule": ((0.018, 0.022), (0.020, 0.035)),
    "mesh": ((0.022, 0.028),),
}


def find_object(name: str) -> ObjectKind:
    """Return the catalogue's entry, or an object of one's own by its mesh file (.stl, .obj).

    UserError: an unknown name, which lists the names, or see `read_hull`.
    """
    if Path(name).suffix.lower() in (".stl", ".obj"):
        if not Path(name).is_file():
            raise UserError(f"there is no mesh {name}")
        return _own_kind(name, Path(name).read_bytes())
    known = CATALOGUE | NEW_KINDS
    if name not in known:
        raise unknown_name("object", name, known)
    return known[name]


@cache
def _own_kind(path: str, content: bytes) -> ObjectKind:
    """Return a mesh file's content as an object with the surface of a printed part."""
    from touchgoal.sim_envs.scene.own_object import read_hull  # loads OpenCV: not for --help

    words = Path(path).stem.replace("_", " ").replace("-", " ")
    material = Material(Texture.RIBBED, 15e-6, 0.6e-3, HARD, 0.6, (0.6, 0.6, 0.65, 1.0))
    return ObjectKind(path, "mesh", material, (words,), read_hull(Path(path), content))


def of_same_shape(name: str, among: Sequence[str]) -> str:
    """Return the next object with the shape of `name`; UserError if there is no other."""
    alike = [other for other in among if find_object(other).shape == find_object(name).shape]
    others = [*alike[alike.index(name) + 1 :], *alike[: alike.index(name)]]
    if not others:
        raise UserError(f"same_shape needs a second {find_object(name).shape} beside {name}")
    return others[0]


def sample_body(
    kind: ObjectKind, rng: np.random.Generator, mass: float, name: str = "object"
) -> Body:
    """Draw an object of this kind with a random size; meshes also get a random convex hull."""
    if kind.hull is not None:
        half = kind.hull.max(0)
        return Body(kind, (float(half[0]), float(half[1]), float(half[2])), mass, name, kind.hull)
    size = tuple(float(rng.uniform(*bounds)) for bounds in _SIZES[kind.shape])
    hull = size[0] * _unit_hull(rng) if kind.shape == "mesh" else None
    return Body(kind, size, mass, name, hull)


def _unit_hull(rng: np.random.Generator) -> Float[np.ndarray, "24 3"]:
    """Draw points near the unit sphere, the shape of a stone."""
    points = rng.normal(size=(24, 3))
    points *= rng.uniform(0.85, 1.0, (24, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    return points * (1.0, 1.0, 1.1)
