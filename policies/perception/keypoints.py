"""Keypoints of feature maps, by a spatial softmax (Finn et al. 2016)."""

import torch
from jaxtyping import Float
from torch import Tensor


def keypoints(
    attention: Float[Tensor, "b k y x"], features: Float[Tensor, "b f y x"]
) -> Float[Tensor, "b p"]:
    """Return the place of each keypoint (x, y in [-1, 1]) and the features there, side by side.

    p is k (2 + f): both coordinates and f features of each keypoint. A keypoint is the mean of all
    cells, weighted by the softmax of its map.
    """
    share = attention.flatten(2).softmax(2)
    h, w = attention.shape[2:]
    y, x = torch.meshgrid(torch.linspace(-1, 1, h), torch.linspace(-1, 1, w), indexing="ij")
    place = torch.stack([x, y]).flatten(1).expand(len(attention), -1, -1).to(features)
    there = torch.cat([place, features.flatten(2)], 1)
    return (share @ there.mT).flatten(1)
