"""Words and pictures for a touch encoder that stays as it is (see `heads`)."""

from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.encoders.alignment.config import HeadsConfig
from touchgoal.encoders.alignment.green_screen import background_changer
from touchgoal.encoders.alignment.heads import Heads, PairedEmbeddings, fit_heads
from touchgoal.encoders.alignment.wand_set import WandSet
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder
from touchgoal.encoders.towers.towers import Towers
from touchgoal.encoders.whitening.simulated_surfaces import pressed_surfaces
from touchgoal.encoders.whitening.surface_words import surface_sentences
from touchgoal.runtime.progress import track

_VISIBLE = 0.2  # least length of an embedding of a visible touch
_PRESSES = 2  # presses of each surface


def add_words(
    encoder: PooledEncoder,
    data: WandSet,
    towers: Towers,
    config: HeadsConfig,
    sensor: SensorModel,
    surfaces: int,
    backgrounds: str,
    seed: int,
) -> PooledEncoder:
    """Return the encoder with heads of words and pictures; its touch embeddings stay the same.

    Args:
        encoder: of touch alone.
        data: touches of objects with views and sentences.
        towers: frozen towers, run once over all views and sentences.
        config: training of the heads.
        sensor: simulated for the random surfaces.
        surfaces: number of random surfaces that teach roughness and bumpiness beside the objects.
        backgrounds: behind the objects in the views, see `background_changer`.
        seed: random seed.
    """
    behind = background_changer(backgrounds, seed)
    touch = torch.from_numpy(data.embed_touches(encoder.embed_frames))
    visible = np.flatnonzero(touch.norm(dim=1).numpy() > _VISIBLE)
    pressed, sentences = _press_surfaces(encoder, sensor, surfaces, seed)
    texts = sorted({s for own in sentences for s in own})
    o, k, m = len(data.names), len(sentences), len(data.sentences)
    describes = np.zeros((o + k, m + len(texts)), bool)
    describes[:o, :m] = data.describes
    describes[o:, m:] = [[text in own for text in texts] for own in sentences]
    labels = np.concatenate([data.label[visible], o + np.repeat(np.arange(k), _PRESSES)])
    paired = PairedEmbeddings(
        touch=F.normalize(torch.cat([touch[visible], pressed]), dim=1),
        label=torch.from_numpy(labels),
        image=torch.from_numpy(data.embed_views(towers, behind)[visible]),
        texts=towers.embed_texts([*data.sentences, *texts]),
        describes=torch.from_numpy(describes),
    )
    return _with_heads(encoder, towers, fit_heads(paired, config, seed))


def _press_surfaces(
    encoder: PooledEncoder, sensor: SensorModel, surfaces: int, seed: int
) -> tuple[Float[Tensor, "n d"], list[list[str]]]:
    """Return the embeddings of random surfaces' presses, one surface after another, and their sentences."""
    rows, sentences = [], []
    pressed = pressed_surfaces(sensor, surfaces, _PRESSES, seed)
    for surface, presses in track(pressed, "embedding surfaces", "surface", surfaces):
        rows += [encoder.embed_frames(after[None], before)[0] for before, after in presses]
        sentences.append(surface_sentences(surface))
    return torch.from_numpy(np.stack(rows)), sentences


def _with_heads(encoder: PooledEncoder, towers: Towers, heads: Heads) -> PooledEncoder:
    """Return a copy of an encoder with these heads."""
    widths = {"text_dim": towers.text_dim, "image_dim": towers.image_dim}
    worded = PooledEncoder(replace(encoder.config, towers=towers.name, **widths))
    own = {name: encoder.state_dict()[name] for name in ("mean", "whitening")}
    text = {"text_mean": heads.text_mean, "text_matrix": heads.text.weight.detach().T}
    image = {"image_mean": heads.image_mean, "image_matrix": heads.image.weight.detach().T}
    worded.load_state_dict({**own, **text, **image})
    return worded.eval()
