"""Touches made by hand: round contacts that move."""

import numpy as np
import torch

from touchgoal.encoders.ssl.frames import TouchFrames

SENSOR = "gelsight_mini_markers"


def moving_blobs(count: int, seed: int = 0, frames: int = 2) -> TouchFrames:
    """Return moving contacts, newest frame first; the "force" holds place and strength."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:120, :160]
    place = rng.uniform((30, 30), (90, 130), (count, 2))
    strength = rng.uniform(1, 4, count)
    speed = rng.uniform(-6, 6, (count, 2)) * (rng.uniform(size=(count, 1)) > 0.5)
    moments = []
    for k in range(frames):
        center = place - k * speed
        distance2 = (y - center[:, 0, None, None]) ** 2 + (x - center[:, 1, None, None]) ** 2
        moments.append(strength[:, None, None] * np.exp(-distance2 / 20**2))
    touch = torch.from_numpy(np.repeat(np.stack(moments, 1)[:, :, None], 3, 2)).half()
    wrench = np.column_stack([place / 100, strength, np.zeros((count, 3))])
    return TouchFrames(touch, torch.from_numpy(wrench).float(), SENSOR, stride=2)
