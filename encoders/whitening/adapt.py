"""Adaptation of a whitened encoder to real videos: their covariance blended in, and sentences."""

from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder
from touchgoal.encoders.towers.towers import Towers
from touchgoal.encoders.whitening.covariance import inverse_square_root, within_classes
from touchgoal.encoders.whitening.text_head import fit_text_head
from touchgoal.episodes.importers.labelled_videos import LabelledVideo, firmest_frames
from touchgoal.episodes.touches import touch_background
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

# Weight of the videos' within-object covariance; the rest is simulation's. Chosen on PhysiCLeAR's
# training objects, where 0.02 to 0.9 do equally well.
_SHARE = 0.1


def adapt(encoder: PooledEncoder, videos: list[LabelledVideo], towers: Towers) -> PooledEncoder:
    """Return an adapted encoder, with a text head for these towers if some videos have ranks.

    UserError: no object has two videos.
    """
    objects = np.array([video.object for video in videos])
    if not videos or np.unique(objects, return_counts=True)[1].max() < 2:
        raise UserError("no object has two videos: film each object at least twice")
    pooled = [_pooled(encoder, video) for video in track(videos, "videos", "video")]
    every = torch.cat(pooled).double().numpy()
    names = np.repeat(objects, [len(rows) for rows in pooled])
    covariance = (1 - _SHARE) * encoder.covariance + _SHARE * within_classes(every, names)
    # The maps of sentences and images were fitted to the old whitening, so they do not fit the new one.
    plain = replace(encoder.config, towers=None, text_dim=0, text_hidden=0, image_dim=0)
    adapted = PooledEncoder(plain).fit(every.mean(0), inverse_square_root(covariance, 0.0))
    ranked = [i for i, video in enumerate(videos) if video.ranks is not None]
    if not ranked:
        return adapted
    ranks = torch.tensor([videos[i].ranks for i in ranked])
    directions = [F.normalize(adapted.whiten(pooled[i]), dim=1).mean(0) for i in ranked]
    head = fit_text_head(torch.stack(directions), ranks, towers.embed_texts)
    worded = PooledEncoder(replace(plain, towers=towers.name, text_dim=towers.text_dim))
    worded.load_state_dict(adapted.state_dict(), strict=False)
    worded.text_map = head
    return worded


def _pooled(encoder: PooledEncoder, video: LabelledVideo) -> Float[Tensor, "k d"]:
    """Return the features of a video's firmest frames."""
    frames = video.frames()
    background = touch_background(frames)
    touch = encoder.preprocess(frames[firmest_frames(frames, background)], background)
    return encoder.pool(torch.from_numpy(touch))
