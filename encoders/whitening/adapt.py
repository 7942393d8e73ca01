"""Adaptation of a whitened encoder to real videos: its centre, its covariance and its sentences."""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder
from touchgoal.encoders.backbones.tower_map import TowerMap
from touchgoal.encoders.towers.towers import Towers
from touchgoal.encoders.whitening.covariance import inverse_square_root, within_classes
from touchgoal.encoders.whitening.text_head import fit_text_head
from touchgoal.episodes.importers.labelled_videos import LabelledVideo, firmest_frames
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

# Weight of the videos' within-object covariance; the rest is simulation's. Chosen on PhysiCLeAR's
# training objects, where 0.02 to 0.9 do equally well.
_SHARE = 0.1


def adapt(encoder: PooledEncoder, videos: list[LabelledVideo], towers: Towers) -> PooledEncoder:
    """Return an encoder adapted to videos; ranks in them replace its sentences by these towers'.

    UserError: no object has two videos.
    """
    objects = np.array([video.object for video in videos])
    if not videos or np.unique(objects, return_counts=True)[1].max() < 2:
        raise UserError("no object has two videos: film each object at least twice")
    pooled = [pool_firmest(encoder, *video.open()) for video in track(videos, "videos", "video")]
    adapted = centre(encoder, pooled, objects)
    ranked = [i for i, video in enumerate(videos) if video.ranks is not None]
    if not ranked:
        return adapted
    ranks = torch.tensor([videos[i].ranks for i in ranked])
    directions = torch.stack([direction(adapted, pooled[i]) for i in ranked])
    return adapted.with_maps(towers, fit_text_head(directions, ranks, towers.embed_texts))


def pool_firmest(
    encoder: PooledEncoder,
    frames: UInt8[np.ndarray, "n h w 3"],
    background: UInt8[np.ndarray, "h w 3"],
) -> Float[Tensor, "k d"]:
    """Return the pooled features of a video's firmest frames."""
    touch = encoder.preprocess(frames[firmest_frames(frames, background)], background)
    return encoder.pool(torch.from_numpy(touch))


def direction(encoder: PooledEncoder, pooled: Float[Tensor, "k d"]) -> Float[Tensor, " d"]:
    """Return the mean direction of a video's touches."""
    return F.normalize(encoder.whiten(pooled), dim=1).mean(0)


def centre(
    encoder: PooledEncoder, pooled: list[Float[Tensor, "k d"]], objects: Shaped[np.ndarray, " n"]
) -> PooledEncoder:
    """Return an encoder centred by the mean of n videos, with their covariance blended in.

    Real touches lie apart from simulated ones, all to one side: about the mean of simulation each of
    them is rough. Sentences and images move with the whitening.
    """
    every = torch.cat(pooled).double().numpy()
    names = np.repeat(objects, [len(rows) for rows in pooled])
    before = encoder.whitening.double().numpy()
    simulated = np.linalg.inv(before @ before.T)  # the covariance that it takes out
    covariance = (1 - _SHARE) * simulated + _SHARE * within_classes(every, names)
    whitening = inverse_square_root(covariance, 0.0)
    centred = PooledEncoder(encoder.config)
    centred.load_state_dict(encoder.state_dict())
    centred.fit(every.mean(0), whitening)
    turn = np.linalg.solve(before, whitening)
    for child in centred.children():
        if isinstance(child, TowerMap):
            child.turn(torch.from_numpy(turn).float())
    return centred.eval()
