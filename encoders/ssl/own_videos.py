"""A fitted encoder adapted to videos of one's own: what differs between presses of one real thing does not matter.

`surface_whitening` knows that from simulation. A share of what videos of the same thing show is blended into
it, and features are centred on what these videos show.
"""

import numpy as np
import torch

from touchgoal.control.errors import UserError
from touchgoal.control.progress import track
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder
from touchgoal.encoders.whitening import inverse_square_root, within_classes
from touchgoal.episodes.importers.labelled_videos import LabelledVideo, firmest_frames
from touchgoal.episodes.touches import touch_background


def adapt(encoder: PooledEncoder, videos: list[LabelledVideo], share: float) -> PooledEncoder:
    """The encoder, adapted in place.

    Args:
        encoder: fitted to simulated surfaces.
        videos: of things that were pressed, several of each; their ranks are not looked at.
        share: of the videos in the covariance that is whitened; 0 centres alone.

    Raises:
        UserError: no thing has two videos.
    """
    things = np.array([video.object for video in videos])
    if not videos or np.unique(things, return_counts=True)[1].max() < 2:
        raise UserError("no thing has two videos, which would show what does not matter about it")
    rows, felt = [], []
    for video in track(videos, "videos", "video"):
        frames = video.frames()
        background = touch_background(frames)
        touch = encoder.preprocess(frames[firmest_frames(frames, background)], background)
        rows.append(encoder.pool(torch.from_numpy(touch)).double().numpy())
        felt += [video.object] * len(touch)
    pooled = np.concatenate(rows)
    covariance = (1 - share) * encoder.covariance + share * within_classes(pooled, np.array(felt))
    return encoder.fit(pooled.mean(0), inverse_square_root(covariance, 0.0))
