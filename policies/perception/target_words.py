"""Sentences that name one object among others: by name, touch, colour and shape."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from touchgoal.encoders.towers.towers import OfflineTowers
from touchgoal.sim_envs.scene.objects import ObjectKind

RGB = tuple[float, float, float] | Float[np.ndarray, "3"]
WORDS_WIDTH = OfflineTowers.text_dim
"""Width of a sentence's embedding."""

COLOURS: dict[str, RGB] = {
    "red": (0.75, 0.15, 0.12), "dark red": (0.5, 0.1, 0.1), "orange": (0.95, 0.55, 0.2),
    "yellow": (0.95, 0.82, 0.22), "green": (0.3, 0.65, 0.25), "dark green": (0.1, 0.35, 0.2),
    "turquoise": (0.2, 0.7, 0.7), "light blue": (0.45, 0.75, 0.88), "blue": (0.2, 0.4, 0.82),
    "purple": (0.5, 0.25, 0.65), "magenta": (0.75, 0.28, 0.5), "pink": (0.93, 0.6, 0.68),
    "brown": (0.5, 0.34, 0.2), "light brown": (0.72, 0.53, 0.33), "beige": (0.8, 0.68, 0.48),
    "cream": (0.96, 0.93, 0.8), "white": (0.95, 0.95, 0.93), "light grey": (0.8, 0.82, 0.85),
    "grey": (0.5, 0.5, 0.54), "black": (0.1, 0.1, 0.12),
}  # fmt: skip
"""Colours of painted objects, RGB in [0, 1]."""
NOUNS = {
    "box": ("block", "box", "cube", "brick"),
    "cylinder": ("cylinder", "can", "tin"),
    "sphere": ("ball", "sphere"),
    "capsule": ("rod", "stick", "bar"),
    "mesh": ("stone", "lump", "rock"),
}
_TEMPLATES = ("{}", "the {}", "the {}", "a {}", "pick up the {}")
_DISTINCT = 0.25  # distance in RGB beyond which two colours are not confused


@dataclass(frozen=True, eq=False)
class Appearance:
    """Kind and colour of an object, by which a person names it."""

    kind: ObjectKind
    rgb: RGB
    painted: bool  # in another colour than its kind's

    @property
    def colour(self) -> str:
        """Nearest name in `COLOURS`."""
        return min(COLOURS, key=lambda name: _distance(COLOURS[name], self.rgb))


def sentence(
    rng: np.random.Generator, target: Appearance, others: Sequence[Appearance]
) -> str | None:
    """Draw a sentence that fits the target and none of the others; None if colour and shape do not
    tell them apart."""
    fitting = _phrases(rng, target, others)
    if not fitting:
        return None
    phrases, weights = zip(*fitting, strict=True)
    phrase = phrases[rng.choice(len(phrases), p=np.array(weights) / sum(weights))]
    if phrase in target.kind.descriptions:
        return phrase
    return _TEMPLATES[rng.integers(len(_TEMPLATES))].format(phrase)


def _phrases(
    rng: np.random.Generator, target: Appearance, others: Sequence[Appearance]
) -> list[tuple[str, float]]:
    """Return phrases, each with its weight in the draw."""
    kind, noun = target.kind, str(rng.choice(NOUNS[target.kind.shape]))
    alike = [other for other in others if other.kind.shape == kind.shape]
    same_colour = [o for o in others if _distance(o.rgb, target.rgb) < _DISTINCT]
    twins = [other for other in alike if other in same_colour]
    found = []
    if not target.painted and not any(other.kind == kind for other in others):
        found.append((kind.name.replace("_", " "), 4.0))
    if not alike:
        found.append((noun, 1.0))
        if not target.painted:
            found.append((str(rng.choice(kind.descriptions)), 1.0))
    if not same_colour:
        found.append((f"{target.colour} {rng.choice(('object', 'one', 'thing'))}", 1.0))
    if not twins:
        found.append((f"{target.colour} {noun}", 4.0))
    return found


def _distance(one: RGB, other: RGB) -> float:
    return float(np.linalg.norm(np.subtract(one, other)))


def embed(sentences: Sequence[str]) -> Float[Tensor, "n d"]:
    """Return the frozen offline tower's embeddings, of length 1; UserError: its wheel is missing."""
    return F.normalize(_towers().embed_texts(list(sentences)), dim=1)


@cache
def _towers() -> OfflineTowers:
    return OfflineTowers()
