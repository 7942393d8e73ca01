"""T1 and T1A: the force on the pad; pressure and shear over it, against the simulator's own."""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from benchmarks.papers.tacbench.attentive import AttentiveProbe
from benchmarks.papers.tacbench.data import RigFrames, Rows
from benchmarks.papers.tacbench.dense import DenseProbe
from benchmarks.papers.tacbench.task import Metrics, Outputs, Targets, split_force
from benchmarks.real_touch.property_probe import interval

_BETA = 0.02  # smooth L1 loss, in shares of the range, as Sparsh
_TOUCHED = 10.0  # weight of pressed cells, which are few
_PRESSED = 0.5  # kPa above which a cell counts as touched


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

    def judge(self, predicted: list[Outputs], validation: list[Outputs], rows: Rows) -> Metrics:
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


class FieldTask:
    """Shear along x and y and pressure, kPa, on 24 x 24 cells.

    The paper shows images alone: real sensors have no ground truth.
    """

    def __init__(self, frames: RigFrames) -> None:
        """Take frames of strokes with their fields."""
        assert frames.field is not None
        self._field, self._stroke = frames.field, frames.stroke
        self.split = split_force(frames)
        sizes = self._field[self.split.train].abs().flatten(2).amax(2)
        shear = torch.quantile(sizes[:, :2], 0.99)
        self._scale = torch.stack([shear, shear, torch.quantile(sizes[:, 2], 0.99)])[:, None, None]
        self.cells = tuple(self._field.shape[1:])

    def probe(self, features: int, grid: tuple[int, int]) -> nn.Module:
        """See Task."""
        return nn.Sequential(DenseProbe(features, grid, 3, self._field.shape[2]), nn.Flatten())

    def targets(self, rows: Rows) -> Targets:
        """Return tractions over their range, by cell."""
        return (self._field[rows] / self._scale).flatten(1)

    def loss(self, outputs: Outputs, targets: Targets) -> Float[Tensor, ""]:
        """Return the smooth L1 loss, weighted towards touched cells."""
        pressure = targets.unflatten(1, self.cells)[:, 2:]
        touched = pressure > _PRESSED / self._scale[2].to(targets)
        weight = (1 + (_TOUCHED - 1) * touched.float()).expand(-1, 3, -1, -1).flatten(1)
        cellwise = F.smooth_l1_loss(outputs, targets, beta=_BETA, reduction="none")
        return (weight * cellwise).mean()

    def read(self, outputs: Outputs) -> Float[Tensor, "b 3 24 24"]:
        """Return tractions, kPa; pressure is never negative."""
        field = outputs.unflatten(1, self.cells) * self._scale
        return torch.cat([field[:, :2], field[:, 2:].clamp(min=0)], 1)

    def error(self, outputs: Outputs, rows: Rows) -> float:
        """Return the root mean square error over frames, components and cells, over each range."""
        wrong = (self.read(outputs) - self._field[rows]) / self._scale
        return float(wrong.square().mean().sqrt())

    def judge(self, predicted: list[Outputs], validation: list[Outputs], rows: Rows) -> Metrics:
        """See `field_metrics`."""
        truth = self._field[rows].numpy()
        read = np.stack([self.read(outputs).numpy() for outputs in predicted])
        return field_metrics(read, truth, self._stroke[rows.numpy()])

    def references(self, rows: Rows) -> dict[str, Metrics]:
        """Return the metrics of a zero field and of the training mean."""
        truth, objects = self._field[rows].numpy(), self._stroke[rows.numpy()]
        mean = self._field[self.split.train].mean(0).numpy()
        guesses = {"(no force anywhere)": 0 * mean, "(mean field of training)": mean}
        return {
            name: field_metrics(np.broadcast_to(guess, (1, *truth.shape)), truth, objects)
            for name, guess in guesses.items()
        }


def field_metrics(
    predicted: Float[np.ndarray, "seeds n 3 h w"],
    truth: Float[np.ndarray, "n 3 h w"],
    objects: np.ndarray,
) -> Metrics:
    """Return explained shares of shear and pressure in touched cells, and errors in kPa.

    1 explains all; 0 is what a zero field reaches.
    """
    touched = truth[:, 2] > _PRESSED
    sums = []
    for part in (slice(0, 2), slice(2, 3)):
        wrong = ((predicted[:, :, part] - truth[:, part]) ** 2).sum(2).mean(0)
        size = (truth[:, part] ** 2).sum(1)
        sums += [(wrong * touched).sum((1, 2)), (size * touched).sum((1, 2))]
    table = np.stack([*sums, touched.sum((1, 2))], 1).astype(float)

    def explained(values: np.ndarray, k: int) -> float:
        return float(1 - values[:, k].sum() / max(values[:, k + 1].sum(), 1e-12))

    count = max(table[:, 4].sum(), 1.0)
    metrics: Metrics = {}
    for k, name in ((0, "shear"), (2, "pressure")):
        metrics[f"{name}_explained"] = explained(table, k)
        metrics[f"{name}_explained_interval"] = list(
            interval(table, objects, lambda values, k=k: explained(values, k))
        )
        metrics[f"{name}_rmse_kpa"] = float(np.sqrt(table[:, k].sum() / count))
    return metrics
