"""T1: the force on the pad."""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from touchgoal.benchmarks.papers.tacbench.data import RigFrames, Rows
from touchgoal.benchmarks.papers.tacbench.task import (
    Metrics,
    Outputs,
    Targets,
    ValidationOutputs,
    split_force,
)
from touchgoal.encoders.probes.attentive import AttentiveProbe
from touchgoal.encoders.probes.property_probe import interval

_BETA = 0.02  # smooth L1 loss, in shares of the force's range, as Sparsh


class ForceTask:
    """Shear along x and y, and normal force.

    Outputs are squashed to shares of each axis' largest training force.
    """

    def __init__(self, frames: RigFrames) -> None:
        """Take frames of strokes."""
        self._frames = frames
        self.split = split_force(frames)
        self._scale = 1.1 * frames.force[self.split.train].abs().amax(0)

    def probe(self, features: int, grid: tuple[int, int]) -> nn.Module:
        """See Task."""
        return AttentiveProbe(features, 3)

    def targets(self, rows: Rows) -> Targets:
        """Return forces over their range."""
        return self._frames.force[rows] / self._scale

    def loss(self, outputs: Outputs, targets: Targets) -> Float[Tensor, ""]:
        """Return the smooth L1 loss."""
        return F.smooth_l1_loss(_squash(outputs), targets, beta=_BETA)

    def read(self, outputs: Outputs) -> Float[Tensor, "b 3"]:
        """Return forces, N."""
        return _squash(outputs) * self._scale

    def error(self, outputs: Outputs, rows: Rows) -> float:
        """Return the root mean square error over frames and axes, N."""
        return float((self.read(outputs) - self._frames.force[rows]).square().mean().sqrt())

    def judge(
        self, predicted: list[Outputs], validation: list[ValidationOutputs], rows: Rows
    ) -> Metrics:
        """See `force_metrics`."""
        truth = self._frames.force[rows]
        errors = np.stack([(self.read(o) - truth).double().numpy() for o in predicted])
        return force_metrics(errors, self._frames.stroke[rows.numpy()])

    def references(self, rows: Rows) -> dict[str, Metrics]:
        """Return the metrics of the training mean."""
        force, objects = self._frames.force, self._frames.stroke[rows.numpy()]
        errors = force[self.split.train].mean(0) - force[rows]
        return {"(mean force of training)": force_metrics(errors.double().numpy()[None], objects)}


def _squash(outputs: Outputs) -> Outputs:
    return torch.cat([outputs[:, :2].tanh(), outputs[:, 2:].sigmoid()], 1)


def force_metrics(errors: Float[np.ndarray, "seeds n 3"], objects: np.ndarray) -> Metrics:
    """Return root mean square and mean absolute errors (mN), by axis and over all, with
    intervals."""
    squares, sizes = 1e6 * (errors**2).mean(0), 1e3 * np.abs(errors).mean(0)

    def root(values: np.ndarray) -> float:
        return float(np.sqrt(values.mean()))

    return {
        "rmse_mn": root(squares),
        "rmse_mn_interval": list(interval(squares, objects, root)),
        "mae_mn": float(sizes.mean()),
        "mae_mn_interval": list(interval(sizes, objects)),
        "rmse_mn_by_axis": np.sqrt(squares.mean(0)).tolist(),
        "mae_mn_by_axis": sizes.mean(0).tolist(),
    }
