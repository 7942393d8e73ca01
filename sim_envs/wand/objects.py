"""The wand's objects: the 102 of MMWand's Table V as shapes, materials and sentences.

`objects.toml` holds them as a person writes them down (mm, g, um); here they become parts in SI
units. Rows, rings and piles are laid out here, the same way every time. Meshes are closed, and fine
enough that a gel does not feel their facets.
"""

import tomllib
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32, Int32
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from touchgoal.runtime.errors import unknown_name
from touchgoal.sim_envs.scene.objects import Material, read_material

Mesh = tuple[Float32[np.ndarray, "_ 3"], Int32[np.ndarray, "_ 3"]]

FINE, COARSE = 0.8e-3, 3e-3
"""m, edges of facets: for the gel (on a ball of 20 mm they stand off by 4 um), and for cameras."""
_LEAST_AROUND, _MOST_AROUND = 24, 200


def ellipsoid(axes: tuple[float, ...], edge: float = FINE) -> Mesh:
    """Return an ellipsoid of these half axes (m) about its centre."""
    steps = _around(max(axes), edge) // 2
    angle = np.linspace(0, np.pi, steps + 1)
    rings = np.column_stack([np.sin(angle), -np.cos(angle)])
    vertices, faces = _revolve(rings, 2 * steps)
    return (vertices * np.array(axes, np.float32)).astype(np.float32), faces


def lathe(profile: Float[np.ndarray, "k 2"], edge: float = FINE) -> Mesh:
    """Return a surface of revolution about z.

    Args:
        profile: radius and z (m) along a path, smooth between the points; a hollow object goes up
            outside and down inside. Both ends are closed to the axis.
        edge: of the facets, m.
    """
    along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(profile, axis=0).T))])
    steps = int(np.clip(along[-1] / (1.5 * edge), 2, 150))
    at = np.union1d(np.linspace(0, along[-1], steps), along)  # corners stay corners
    smooth = PchipInterpolator(along, profile)(at)  # never overshoots
    ends = [[0, smooth[0, 1]]], smooth, [[0, smooth[-1, 1]]]
    return _revolve(np.concatenate(ends), _around(profile[:, 0].max(), edge))


def prism(sides: int, radius: float, half_length: float) -> Mesh:
    """Return a regular prism about z: `radius` (m) of its corners, half its length (m)."""
    ends = [[0, -half_length], [radius, -half_length], [radius, half_length], [0, half_length]]
    return _revolve(np.array(ends), sides)


def _around(radius: float, edge: float) -> int:
    return int(np.clip(2 * np.pi * radius / edge, _LEAST_AROUND, _MOST_AROUND)) // 2 * 2


def _revolve(rings: Float[np.ndarray, "k 2"], around: int) -> Mesh:
    """Turn radii and heights about z; the first and the last radius are 0."""
    angle = np.arange(around) * 2 * np.pi / around
    inner = rings[1:-1]
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    sides = np.concatenate(
        [inner[:, None, :1] * circle, np.broadcast_to(inner[:, None, 1:], (len(inner), around, 1))],
        axis=2,
    ).reshape(-1, 3)
    vertices = np.concatenate([[[0, 0, rings[0, 1]]], sides, [[0, 0, rings[-1, 1]]]])
    now, after = np.arange(around), (np.arange(around) + 1) % around
    bottom, top = 0, len(vertices) - 1
    faces = [np.column_stack([np.full(around, bottom), 1 + after, 1 + now])]
    for i in range(len(inner) - 1):
        low, high = 1 + i * around, 1 + (i + 1) * around
        faces.append(np.column_stack([low + now, low + after, high + after]))
        faces.append(np.column_stack([low + now, high + after, high + now]))
    last = 1 + (len(inner) - 1) * around
    faces.append(np.column_stack([last + now, last + after, np.full(around, top)]))
    return vertices.astype(np.float32), np.concatenate(faces).astype(np.int32)


Look = Literal["plain", "speckled", "checker", "gradient"]
_PRIMITIVES = ("box", "cylinder", "sphere", "capsule")


@dataclass(frozen=True, eq=False)
class Part:
    """One rigid piece of an object."""

    shape: str  # "box", "cylinder", "sphere", "capsule" or "mesh"
    size: tuple[float, ...]  # half extents as MuJoCo takes them, m; of a mesh none
    # of its centre, m, in the object's frame (z up, bench at z = 0)
    position: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]  # its axes in the object's frame
    material: Material  # how it feels, and its colour
    look: Look  # pattern of two colours
    second_rgb: tuple[float, float, float]  # the pattern's other colour
    # mesh, coarse: vertices (m) and faces of a mesh, for the gel and for cameras
    mesh: Mesh | None
    coarse: Mesh | None


@dataclass(frozen=True, eq=False)
class WandObject:
    """One object of the catalogue."""

    name: str  # its id
    number: int  # in MMWand's Table V
    mass: float  # kg
    descriptions: tuple[str, ...]  # how it feels, in different words
    _entry: dict[str, Any]

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """The rigid pieces that it is made of."""
        common = {k: v for k, v in self._entry.items() if k != "parts"}
        rng = np.random.default_rng(self.number)
        return tuple(p for one in self._entry["parts"] for p in _parts(common | one, rng))


@cache
def wand_objects() -> dict[str, WandObject]:
    """Return the catalogue, in the paper's order."""
    entries = tomllib.loads(Path(__file__).with_name("objects.toml").read_text())
    return {
        name: WandObject(name, e["number"], e["mass"] * 1e-3, tuple(e["descriptions"]), e)
        for name, e in entries.items()
    }


def find_wand_object(name: str) -> WandObject:
    """Return an object; UserError lists the names."""
    if name not in wand_objects():
        raise unknown_name("object", name, wand_objects())
    return wand_objects()[name]


def _parts(entry: dict[str, Any], rng: np.random.Generator) -> list[Part]:
    """Return the parts of one entry: one, or all of its row, ring or pile."""
    part = _part(entry)
    if row := entry.get("row"):
        step = np.array(row["step"]) * 1e-3
        return [replace(part, position=part.position + i * step) for i in range(row["count"])]
    if ring := entry.get("ring"):
        angles = np.arange(ring["count"]) * 2 * np.pi / ring["count"]
        turns = Rotation.from_rotvec(angles[:, None] * [0, 0, 1])
        outwards = np.array([ring["radius"] * 1e-3, 0, 0])
        return [
            replace(part, position=part.position + turn @ outwards, rotation=turn @ part.rotation)
            for turn in turns.as_matrix()
        ]
    if pile := entry.get("pile"):
        return [_in_pile(part, np.array(pile["spread"]) * 1e-3, rng) for _ in range(pile["count"])]
    return [part]


def _in_pile(part: Part, spread: Float[np.ndarray, "3"], rng: np.random.Generator) -> Part:
    """Scatter a part over a heap: highest in the middle, turned at random."""
    away, angle = np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
    x, y = away * np.cos(angle), away * np.sin(angle)
    rotation = Rotation.random(rng=rng).as_matrix()
    lowest = -part.size[0] if part.coarse is None else float((part.coarse[0] @ rotation[2]).min())
    height = rng.uniform(0.55, 1) * 2 * spread[2] * (1 - away**2)
    place = np.array([x * spread[0], y * spread[1], max(height, -lowest)])
    return replace(part, position=part.position + place, rotation=rotation)


def _part(entry: dict[str, Any]) -> Part:
    shape, size = entry["shape"], tuple(1e-3 * s for s in entry.get("size", ()))
    mesh = coarse = None
    if shape == "ellipsoid":
        mesh, coarse = ellipsoid(size), ellipsoid(size, COARSE)
    elif shape == "lathe":
        profile = np.array(entry["profile"]) * 1e-3
        mesh, coarse = lathe(profile), lathe(profile, COARSE)
    elif shape == "prism":
        mesh = coarse = prism(entry["sides"], *size)
    elif shape not in _PRIMITIVES:
        raise ValueError(f"unknown shape {shape!r}")
    return Part(
        shape=shape if mesh is None else "mesh",
        size=size if mesh is None else (),
        position=np.array(entry.get("at", (0, 0, 0))) * 1e-3,
        rotation=Rotation.from_euler("xyz", entry.get("turn", (0, 0, 0)), degrees=True).as_matrix(),
        material=read_material(entry),
        look=entry.get("look", "plain"),
        second_rgb=tuple(entry.get("rgb2", entry["rgb"])),
        mesh=mesh,
        coarse=coarse,
    )
