"""Training data for the maps from sentences and images to a fixed touch encoder (see `heads`)."""

from collections.abc import Callable

import numpy as np
import torch

from touchgoal.control.arrays import Image
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.encoders.alignment.described_touches import DescribedTouches
from touchgoal.encoders.alignment.wand_set import WandSet
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder
from touchgoal.encoders.ssl.frames import check_sensor
from touchgoal.encoders.towers.towers import Towers
from touchgoal.encoders.whitening.simulated_surfaces import pressed_surfaces
from touchgoal.encoders.whitening.text_head import RANK_WORDS
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.tactile.rig.surfaces import TILE, TILE_PITCH, Surface

_PRESSES = 2  # presses of each surface


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
