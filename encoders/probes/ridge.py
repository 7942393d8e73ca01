"""Linear probes: ridge regressions from frozen embeddings."""

import torch
from jaxtyping import Float
from torch import Tensor

_STRENGTH = 1e-3  # of the ridge, as a share of the number of samples


def ridge_r2(
    inputs: Float[Tensor, "n d"],
    targets: Float[Tensor, "n k"],
    test_inputs: Float[Tensor, "m d"],
    test_targets: Float[Tensor, "m k"],
) -> Float[Tensor, " k"]:
    """Return the share of each target's variance that a ridge explains on other inputs.

    Columns are brought to variance 1.
    """
    mean, spread = inputs.mean(0), inputs.std(0).clamp(min=1e-6)
    X, Y = ((inputs - mean) / spread).double(), targets.double()
    offset = Y.mean(0)
    gram = X.T @ X + _STRENGTH * len(X) * torch.eye(X.shape[1], dtype=X.dtype)
    weights = torch.linalg.solve(gram, X.T @ (Y - offset))
    read = ((test_inputs - mean) / spread).double() @ weights + offset
    error = ((read - test_targets) ** 2).mean(0)
    return (1 - error / test_targets.double().var(0, correction=0)).float()
