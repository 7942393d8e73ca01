"""Within-class covariance normalisation (Hatch et al. 2006)."""

import numpy as np
from jaxtyping import Float, Shaped

_LEAST = 1e-12  # variance: samples that do not differ at all


def inverse_square_root(
    covariance: Float[np.ndarray, "d d"], shrinkage: float
) -> Float[np.ndarray, "d d"]:
    """Return V with V.T C V the identity, C the covariance shrunk towards a sphere."""
    size = len(covariance)
    sphere = max(np.trace(covariance) / size, _LEAST) * np.eye(size)
    values, vectors = np.linalg.eigh((1 - shrinkage) * covariance + shrinkage * sphere)
    return vectors / np.sqrt(values)


def within_classes(
    samples: Float[np.ndarray, "n d"], classes: Shaped[np.ndarray, " n"]
) -> Float[np.ndarray, "d d"]:
    """Return the covariance about the mean of each class."""
    apart = samples.astype(np.float64)
    names = np.unique(classes)
    for name in names:
        apart[classes == name] -= apart[classes == name].mean(0)
    return apart.T @ apart / max(len(samples) - len(names), 1)
