"""Maps of sentences and images to the embeddings of a fixed touch encoder (see `heads`)."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from touchgoal.control.arrays import Image
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.encoders.alignment.described_touches import DescribedTouches
from touchgoal.encoders.alignment.heads import Heads
from touchgoal.encoders.alignment.wand_set import WandSet
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder
from touchgoal.encoders.ssl.frames import check_sensor
from touchgoal.encoders.towers.towers import Towers
from touchgoal.encoders.whitening.simulated_surfaces import pressed_surfaces
from touchgoal.encoders.whitening.surface_words import surface_sentences
from touchgoal.runtime.progress import track

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


def with_heads(encoder: PooledEncoder, towers: Towers, heads: Heads) -> PooledEncoder:
    """Return a copy of an encoder with these heads; its touch embeddings stay the same."""
    own = {
        "text_dim": towers.text_dim,
        "text_hidden": heads.text.hidden,
        "image_dim": towers.image_dim,
    }
    worded = PooledEncoder(replace(encoder.config, towers=towers.name, **own))
    worded.fit(encoder.mean.numpy(), encoder.whitening.numpy())
    worded.text_map, worded.image_map = heads.text, heads.image
    return worded.eval().requires_grad_(False)
