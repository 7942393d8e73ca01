"""What probes of TacBench read, as pictures."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from touchgoal.benchmarks.tacbench.data import RigFrames, Rows
from touchgoal.benchmarks.tacbench.tasks import CLASSES, ForceTask, PoseTask, SlipTask, Task
from touchgoal.sim_envs.indenter_rig import FRICTION

_AXES = "xyz"


@dataclass(frozen=True)
class Read:
    """What the first seed's probe put out for test frames: `outputs` of the frames `rows`."""

    task: Task
    frames: RigFrames
    encoder: str
    share: float
    test: str
    rows: Rows
    outputs: torch.Tensor


def draw(reads: list[Read]) -> UInt8[np.ndarray, "h w 3"]:
    """Of the first encoder and share: force against truth, friction cone, slip over time, confusion."""
    chosen = {
        type(r.task): r
        for r in reversed(reads)
        if (r.encoder, r.share) == (reads[0].encoder, reads[0].share)
    }
    figure = Figure(figsize=(16, 3.6 * len(chosen)), dpi=90, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(len(chosen), 4, squeeze=False)
    for line, one in zip(axes, reversed(chosen.values()), strict=True):
        if isinstance(one.task, ForceTask):
            _draw_force(line, one, one.task)
        elif isinstance(one.task, SlipTask):
            _draw_slip(line, one, one.task)
        elif isinstance(one.task, PoseTask):
            _draw_pose(line, one, one.task)
    figure.suptitle(f"{reads[0].encoder}, {reads[0].share:.2g} of the labels")
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _draw_force(axes: np.ndarray, one: Read, task: ForceTask) -> None:
    truth, said = one.frames.force[one.rows].numpy(), task.read(one.outputs).numpy()
    for k, axis in enumerate(axes[:3]):
        ends = [min(truth[:, k].min(), said[:, k].min()), max(truth[:, k].max(), said[:, k].max())]
        axis.plot(ends, ends, color="0.6", linewidth=1)
        axis.scatter(truth[:, k], said[:, k], s=3, alpha=0.4)
        axis.set(xlabel=f"true force {_AXES[k]} (N)", ylabel="predicted (N)", title=one.test)
    _draw_cone(axes[3], truth, np.linalg.norm(said - truth, axis=1))


def _draw_cone(axis: Axes, truth: np.ndarray, error: np.ndarray) -> None:
    """Shear over normal force of every test frame, coloured by the error, as Sparsh's Figures 7 and 8."""
    most = truth[:, 2].max()
    for side in (-1, 1):
        axis.plot([0, side * FRICTION * most], [0, most], color="0.6", linewidth=1)
    points = axis.scatter(truth[:, 0], truth[:, 2], s=3, c=1e3 * error, cmap="viridis")
    axis.figure.colorbar(points, ax=axis, label="error (mN)")
    axis.set(xlabel="shear x (N)", ylabel="normal force (N)", title="nominal friction cone")


def _draw_slip(axes: np.ndarray, one: Read, task: SlipTask) -> None:
    """Four test strokes with slip, as Sparsh's Figure 11."""
    stroke, truth = one.frames.stroke[one.rows.numpy()], task.truth(one.rows)
    likely = torch.sigmoid(one.outputs[:, 0]).numpy()
    slipping = [s for s in np.unique(stroke) if truth[stroke == s].any()]
    for axis, number in zip(axes, slipping, strict=False):
        own = stroke == number
        force = one.frames.force[one.rows][torch.from_numpy(own)].numpy()
        axis.fill_between(
            np.arange(own.sum()), truth[own].astype(float), step="mid", alpha=0.25, label="slips"
        )
        axis.plot(likely[own], label="probe says")
        ratio = np.hypot(force[:, 0], force[:, 1]) / np.maximum(force[:, 2], 1e-9)
        axis.plot(ratio, color="0.5", label="shear over normal force")
        axis.axhline(FRICTION, color="0.5", linewidth=0.7, linestyle=":")
        axis.set(xlabel="frames since touch", ylim=(-0.05, 1.05), title=f"test stroke {number}")
    if slipping:
        axes[0].legend(fontsize=7)


def _draw_pose(axes: np.ndarray, one: Read, task: PoseTask) -> None:
    """Confusion matrices, as Sparsh's Figure 13."""
    truth, said = task.classes[one.rows].numpy(), task.read(one.outputs).numpy()
    for k, (axis, name) in enumerate(zip(axes, ("x", "y", "turn"), strict=False)):
        counts = np.zeros((CLASSES, CLASSES))
        np.add.at(counts, (truth[:, k], said[:, k]), 1)
        shares = counts / np.maximum(counts.sum(1, keepdims=True), 1)
        image = axis.imshow(shares, vmin=0, vmax=1, cmap="viridis")
        axis.set(xlabel="predicted class", ylabel="true class", title=f"change of {name}")
        axis.figure.colorbar(image, ax=axis)
    axes[3].axis("off")
