"""Words and pictures for a touch encoder that stays as it is (see `heads`)."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.encoders.alignment.config import HeadsConfig
from touchgoal.encoders.alignment.green_screen import background_changer
from touchgoal.encoders.alignment.heads import Paired, fit_heads
from touchgoal.encoders.alignment.wand_set import WandSet
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder
from touchgoal.encoders.towers.towers import Towers
from touchgoal.encoders.whitening.simulated_surfaces import pressed_surfaces
from touchgoal.encoders.whitening.surface_words import surface_sentences
from touchgoal.runtime.progress import track

_FELT = 0.2  # length of an embedding below which a touch shows nothing


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
    touch = _embed(encoder, (data.pictures(i) for i in range(len(data))), len(data), "touches")
    felt = np.flatnonzero(touch.norm(dim=1).numpy() > _FELT)
    sentences, describes = list(data.sentences), data.describes
    random = list(pressed_surfaces(sensor, surfaces, 2, seed))
    pressed = _embed(
        encoder, (pair for _, pairs in random for pair in pairs), 2 * surfaces, "surfaces"
    )
    said = [surface_sentences(surface) for surface, _ in random]
    words = sorted({s for four in said for s in four})
    on_words = np.array([[w in four for w in words] for four in said])
    o, k = len(describes), len(random)
    whole = np.zeros((o + k, len(sentences) + len(words)), bool)
    whole[:o, : len(sentences)], whole[o:, len(sentences) :] = describes, on_words
    labels = np.concatenate([data.label[felt], o + np.repeat(np.arange(k), 2)])
    paired = Paired(
        touch=F.normalize(torch.cat([touch[felt], pressed]), dim=1),
        label=torch.from_numpy(labels),
        image=torch.from_numpy(data.embed_views(towers, behind)[felt]),
        texts=towers.embed_texts(sentences + words),
        describes=torch.from_numpy(whole),
    )
    heads = fit_heads(paired, config, seed)
    worded = PooledEncoder(
        replace(
            encoder.config, towers=towers.name, text_dim=towers.text_dim, image_dim=towers.image_dim
        )
    )
    worded.load_state_dict(
        {
            **{name: encoder.state_dict()[name] for name in ("mean", "whitening")},
            "text_mean": heads.text_mean,
            "text_matrix": heads.text.weight.detach().T,
            "image_mean": heads.image_mean,
            "image_matrix": heads.image.weight.detach().T,
        }
    )
    return worded.eval()


@torch.no_grad()
def _embed(
    encoder: PooledEncoder,
    pairs: Iterator[tuple[np.ndarray, np.ndarray]],
    count: int,
    what: str,
) -> Float[Tensor, "n d"]:
    """Embed pictures, each against its own untouched one."""
    rows = []
    for untouched, touched in track(pairs, f"embedding {what}", "picture", count):
        touch = torch.from_numpy(encoder.preprocess(touched[None], untouched))
        rows.append(encoder.embed_touch(touch)[0])
    return torch.stack(rows)
