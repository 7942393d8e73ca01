"""Touch embeddings with sentences on what was touched, of three sources, and how they are joined for `heads`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float32
from torch import Tensor

from touchgoal.control.arrays import Image
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.encoders.alignment.heads import PairedEmbeddings
from touchgoal.encoders.alignment.wand_set import WandSet
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder
from touchgoal.encoders.pretrained import AnyTouchEncoder
from touchgoal.encoders.ssl.frames import check_sensor
from touchgoal.encoders.towers.towers import Towers
from touchgoal.encoders.whitening.simulated_surfaces import pressed_surfaces
from touchgoal.encoders.whitening.text_head import RANK_WORDS
from touchgoal.episodes.format.joined import load_episodes
from touchgoal.episodes.touches import check_touches, descriptions, draw_frames
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.tactile.rig.surfaces import TILE, TILE_PITCH, Surface

_VISIBLE = 0.2  # least length of an embedding of a visible touch
_PRESSES = 2  # presses of each random surface


@dataclass(frozen=True, eq=False)
class DescribedTouches:
    """n touches of objects on which there are sentences."""

    touch: Float32[np.ndarray, "n d"]  # embeddings
    object: tuple[str, ...]  # name of the object of each touch
    sentences: dict[str, list[str]]  # on each object
    image: Float[Tensor, "n v i"] | None = None  # image tower's embeddings of views of each

    def visible(self) -> "DescribedTouches":
        """Return the touches that the tactile image shows."""
        rows = np.flatnonzero(np.linalg.norm(self.touch, axis=1) > _VISIBLE)
        return replace(
            self,
            touch=self.touch[rows],
            object=tuple(self.object[i] for i in rows),
            image=None if self.image is None else self.image[rows],
        )


def embed_grasps(encoder: AnyTouchEncoder, root: Path, frames: int, seed: int) -> DescribedTouches:
    """Embed frames with contact of episodes in which objects are grasped.

    UserError: the set has no touch, no descriptions or no contact, or is another sensor's.

    Args:
        root: episode set whose meta has `object` and `descriptions`, such as `collect-demos` records;
            it needs no cameras.
        frames: number of each episode, both fingertips together.
    """
    episodes = load_episodes(root)
    sides = check_touches(episodes)
    rows, objects = [], []
    for i in track(range(len(episodes)), "embedding grasps", "episode"):
        if encoder.config.sensor is not None:
            check_sensor(episodes, i, encoder.config.sensor)
        drawn = draw_frames(episodes, i, frames, 0, seed)
        for side in range(len(sides)):
            own = drawn.frames[drawn.column == side]
            rows.append(encoder.embed_frames(own, drawn.background[side]))
            objects += [str(episodes.meta(i)["object"])] * len(own)
    if not objects:
        raise UserError(f"{root} has no contact: give episodes with contact")
    return DescribedTouches(np.concatenate(rows), tuple(objects), descriptions(episodes))


def embed_wand(
    encoder: PooledEncoder, data: WandSet, towers: Towers, change: Callable[[Image], Image]
) -> DescribedTouches:
    """Embed the touches of the wand and, after a change, their views; UserError: of another sensor."""
    check_sensor(data.episodes, 0, encoder.config.sensor)
    return DescribedTouches(
        touch=data.embed_touches(encoder.embed_frames),
        object=tuple(data.names[k] for k in data.label),
        sentences=data.sentences_by_object(),
        image=torch.from_numpy(data.embed_views(towers, change)),
    )


def embed_surfaces(
    encoder: PooledEncoder, sensor: SensorModel, surfaces: int, seed: int
) -> DescribedTouches:
    """Embed presses of random surfaces, which teach roughness and bumpiness beside the objects."""
    rows, objects, sentences = [], [], {}
    pressed = pressed_surfaces(sensor, surfaces, _PRESSES, seed)
    for surface, presses in track(pressed, "embedding surfaces", "surface", surfaces):
        name = f"surface {len(sentences)}"
        rows += [encoder.embed_frames(after[None], before)[0] for before, after in presses]
        objects += [name] * len(presses)
        sentences[name] = surface_sentences(surface)
    return DescribedTouches(np.stack(rows), tuple(objects), sentences)


_FINE = 1.5e-3  # m, wavelength: finer texture is roughness, coarser is bumps
# um: thresholds between the ranks, for the standard deviation of the fine and the coarse part: a
# third of random surfaces lies below, a third above.
_ROUGH, _BUMPY = (14.0, 28.0), (35.0, 110.0)


def surface_sentences(surface: Surface) -> list[str]:
    """Return four sentences on roughness and bumpiness; the ranks are PhysiCLeAR's.

    None is on hardness: a random surface's softness says little about real tactile images. With such
    sentences the hardness of real objects was read at chance, and accuracy on seen objects fell from 0.80
    to 0.59.
    """
    rough, bumpy = (
        RANK_WORDS[k][rank] for k, rank in zip((1, 2), surface_ranks(surface), strict=True)
    )
    return [
        f"a {rough} object",
        f"a {bumpy} object",
        f"a {rough} and {bumpy} object",
        f"it feels {rough} and {bumpy}",
    ]


def surface_ranks(surface: Surface) -> tuple[int, int]:
    """Return roughness and bumpiness of a surface, 0 to 2."""
    spectrum = np.fft.rfft2(surface.texture)  # a tile repeats, so the split is exact
    along, across = np.fft.fftfreq(TILE, TILE_PITCH), np.fft.rfftfreq(TILE, TILE_PITCH)
    is_fine = np.hypot(along[:, None], across) > 1 / _FINE
    spectrum[0, 0] = 0  # mean height is neither
    parts = (np.fft.irfft2(np.where(kept, spectrum, 0)) for kept in (is_fine, ~is_fine))
    fine, coarse = (1e6 * float(part.std()) for part in parts)
    return int(np.searchsorted(_ROUGH, fine)), int(np.searchsorted(_BUMPY, coarse))


def pair(sets: Sequence[DescribedTouches], towers: Towers) -> PairedEmbeddings:
    """Join sets for the training of heads, those with views first.

    An object that has the same name in two sets is one object with the sentences of both.
    """
    sets = sorted((own.visible() for own in sets), key=lambda own: own.image is None)
    of: dict[str, set[str]] = {}
    for own in sets:
        for name, sentences in own.sentences.items():
            of.setdefault(name, set()).update(sentences)
    names, texts = sorted(of), sorted(set().union(*of.values()))
    place = {name: k for k, name in enumerate(names)}
    return PairedEmbeddings(
        touch=F.normalize(torch.from_numpy(np.concatenate([own.touch for own in sets])), dim=1),
        label=torch.tensor([place[name] for own in sets for name in own.object]),
        image=torch.cat([own.image for own in sets if own.image is not None]),
        texts=towers.embed_texts(texts),
        describes=torch.tensor([[text in of[name] for text in texts] for name in names]),
    )
