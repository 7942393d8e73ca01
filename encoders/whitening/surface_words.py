"""Sentences on how a random surface feels: roughness and bumpiness, from its height map.

The ranks are PhysiCLeAR's. There are no sentences on hardness: a random surface's softness says
little about real tactile images, and with them the hardness of real objects was read at chance and
accuracy on seen objects fell from 0.80 to 0.59.
"""

import numpy as np

from touchgoal.encoders.whitening.text_head import RANK_WORDS
from touchgoal.sim_envs.tactile.rig.surfaces import TILE, TILE_PITCH, Surface

_FINE = 1.5e-3  # m, wavelength: finer texture is roughness, coarser is bumps
# um: thresholds between the ranks, for the standard deviation of the fine and the coarse part: a
# third of random surfaces lies below, a third above.
_ROUGH, _BUMPY = (14.0, 28.0), (35.0, 110.0)


def surface_sentences(surface: Surface) -> list[str]:
    """Return four sentences on a surface."""
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
