"""A fitted encoder adapted to videos of one's own: what differs between presses of one real thing does not matter.

`surface_whitening` knows that from simulation. A share of what videos of the same thing show is blended into
it, and features are centred on what these videos show. Where the things are ranked for how they feel, the
encoder learns the words for it, too.
"""

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


def adapt(
    encoder: PooledEncoder, videos: list[LabelledVideo], share: float, towers: Towers
) -> PooledEncoder:
    """A new encoder, which knows sentences of these towers if some of the videos are ranked.

    Args:
        encoder: fitted to simulated surfaces.
        videos: of things that were pressed, several of each.
        share: of the videos in the covariance that is whitened; 0 centres alone.
        towers: whose sentences it shall know.

    Raises:
        UserError: no thing has two videos.
    """
    things = np.array([video.object for video in videos])
    if not videos or np.unique(things, return_counts=True)[1].max() < 2:
        raise UserError("no thing has two videos, which would show what does not matter about it")
    pooled = [_pooled(encoder, video) for video in track(videos, "videos", "video")]
    every = torch.cat(pooled).double().numpy()
    names = np.repeat(things, [len(rows) for rows in pooled])
    covariance = (1 - share) * encoder.covariance + share * within_classes(every, names)
    adapted = PooledEncoder(encoder.config).fit(every.mean(0), inverse_square_root(covariance, 0.0))
    ranked = [i for i, video in enumerate(videos) if video.ranks is not None]
    if not ranked:
        return adapted
    ranks = torch.tensor([videos[i].ranks for i in ranked])
    directions = [F.normalize(adapted.whiten(pooled[i]), dim=1).mean(0) for i in ranked]
    head = fit_text_head(torch.stack(directions), ranks, towers.embed_texts)
    worded = PooledEncoder(replace(encoder.config, towers=towers.name, text_dim=towers.text_dim))
    worded.load_state_dict(
        {**adapted.state_dict(), "text_mean": head.mean, "text_matrix": head.matrix}
    )
    return worded


def _pooled(encoder: PooledEncoder, video: LabelledVideo) -> Float[Tensor, "k d"]:
    """Features of a video's firmest frames."""
    frames = video.frames()
    background = touch_background(frames)
    touch = encoder.preprocess(frames[firmest_frames(frames, background)], background)
    return encoder.pool(torch.from_numpy(touch))
