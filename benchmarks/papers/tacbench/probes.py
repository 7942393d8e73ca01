"""Probes on frozen encoders, and encoders trained end to end with them."""

import contextlib
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

import torch
from jaxtyping import Float, Float16
from torch import Tensor, nn

from benchmarks.papers.tacbench.config import Config
from benchmarks.papers.tacbench.data import STRIDE, RigFrames, Rows
from benchmarks.papers.tacbench.task import Outputs, Task
from benchmarks.real_touch.embedders import untrained, vit_of
from touchgoal.encoders.backbones.touch_backbone import (
    BATCH,
    BaseTouchEncoder,
    TouchBackbone,
    TouchBackboneConfig,
)
from touchgoal.encoders.backbones.vit import PRESETS
from touchgoal.encoders.pretrained import load_encoder
from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.encoders.training.trainer import OptimizerConfig, Training, fit
from touchgoal.runtime.progress import track

END_TO_END, RANDOM = "end-to-end:", "random:"
_SNAPSHOTS = 8  # snapshots of a training; the best on validation frames is kept
_MAX_VALIDATION = 160  # frames, evenly drawn
_WEIGHT_DECAY = 0.05

Inputs = Float[Tensor, "b ..."]


class PairTokens(nn.Module):
    """An encoder's tokens of a frame and of the one before it, side by side at every patch.

    An encoder that looks back by itself gives its own tokens. `offsets` are the frames before the
    newest that are read, `features` the width of a token, `grid` rows and columns of the patches.
    """

    def __init__(self, encoder: BaseTouchEncoder) -> None:
        """Take an encoder with a ViT; UserError for any other."""
        super().__init__()
        self.vit = vit_of(encoder)
        self.looks_back, self._stack = len(encoder.offsets) > 1, encoder.stack
        self.offsets = encoder.offsets if self.looks_back else (0, STRIDE)
        self.features = self.vit.config.width * (1 if self.looks_back else 2)
        patch = self.vit.config.patch_size
        rows, columns = (-(-side // patch) for side in encoder.preprocess.size)
        self.grid = rows, columns

    def forward(self, frames: Float[Tensor, "b n 3 h w"]) -> Float[Tensor, "b t f"]:
        """Return the tokens of frames at `offsets`."""
        if self.looks_back:
            return self.vit(self._stack(frames))
        tokens = self.vit(frames.flatten(0, 1)).unflatten(0, (len(frames), 2))
        return tokens.transpose(1, 2).flatten(2)


def find_encoder_of(name: str, sensor: str, seed: int) -> BaseTouchEncoder:
    """Find an encoder by its name in the benchmark: see `Config.encoders`.

    The sensor is the rig's, for a preset's network; the seed is of random weights.
    """
    preset = name.removeprefix(END_TO_END)
    if preset != name and preset in PRESETS:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return TouchBackbone(TouchBackboneConfig.for_sensor(PRESETS[preset], sensor))
    for prefix in (RANDOM, END_TO_END):
        if name.startswith(prefix):
            return untrained(name.removeprefix(prefix), seed)
    return load_encoder(name).eval()


@torch.no_grad()
def frozen_tokens(encoder: BaseTouchEncoder, frames: RigFrames) -> Float16[Tensor, "n t f"]:
    """Return a frozen encoder's tokens of every frame, each computed once."""
    tokens = PairTokens(encoder).eval()
    every = track(torch.arange(len(frames.before)).split(BATCH), "embedding", "batch")
    if tokens.looks_back:
        batches = (frames.stacked(rows, tokens.offsets) for rows in every)
        return torch.cat([tokens(batch).half() for batch in batches])
    return torch.cat([tokens.vit(frames.touch[rows].float()).half() for rows in every])


def inputs_of_tokens(
    pairs: PairTokens, tokens: Float16[Tensor, "n t f"], frames: RigFrames
) -> Callable[[Rows], Inputs]:
    """Return a frozen encoder's input to the probe by row, see `PairTokens`."""
    if pairs.looks_back:
        return lambda rows: tokens[rows].float()
    return lambda rows: torch.cat([tokens[rows], tokens[frames.before[rows]]], 2).float()


class Reader(nn.Module):
    """A probe, with its encoder if that is trained."""

    def __init__(self, task: Task, tokens: PairTokens, trained: bool) -> None:
        """Build a task's probe with random weights, and an encoder to train if one is given."""
        super().__init__()
        self.encoder = tokens if trained else None
        self.probe = task.probe(tokens.features, tokens.grid)
        self._task = [task]  # in a list: not part of the state

    def outputs(self, inputs: Inputs) -> Outputs:
        """Return the probe's outputs on frozen tokens, or on frames when the encoder is trained."""
        return self.probe(inputs if self.encoder is None else self.encoder(inputs))

    def forward(self, inputs: Inputs, targets: Tensor) -> dict[str, Tensor]:
        """Return the loss, for the trainer."""
        return {"loss": self._task[0].loss(self.outputs(inputs), targets)}


def train_reader(
    reader: Reader,
    task: Task,
    inputs_of: Callable[[Rows], Inputs],
    train: Rows,
    config: Config,
    seed: int,
    scratch: Path,
    log: TextIO,
) -> None:
    """Train a reader on some rows and keep the snapshot that does best on validation frames.

    Snapshots go to the folder `scratch`, the trainer's lines to `log`.
    """
    steps, batch_size, lr = config.steps, config.batch_size, config.lr
    if reader.encoder is not None:
        steps, batch_size = config.end_to_end_steps, config.end_to_end_batch_size
        lr = config.end_to_end_lr
    per_snapshot = max(steps // _SNAPSHOTS, 1) * batch_size
    every = max(-(-len(task.split.validation) // _MAX_VALIDATION), 1)
    validation = task.split.validation[::every]
    best: dict[str, Tensor] = {}
    least = float("inf")

    def batch(rows: Tensor, noise: BatchNoise) -> dict[str, Tensor]:
        drawn = train[noise.randint(len(train), (len(rows),))]
        return {"inputs": inputs_of(drawn), "targets": task.targets(drawn)}

    def evaluate() -> dict[str, float]:
        nonlocal least
        error = task.error(read(reader, inputs_of, validation), validation)
        if error < least:
            least = error
            best.update({name: value.clone() for name, value in reader.state_dict().items()})
        return {"validation_error": error}

    epochs = min(steps, _SNAPSHOTS)
    optimizer = OptimizerConfig(epochs, batch_size, lr, _WEIGHT_DECAY, max_grad_norm=1.0)
    work = Training(reader, per_snapshot, batch, optimizer, identity={}, evaluate=evaluate)
    with tempfile.TemporaryDirectory(dir=scratch) as folder, contextlib.redirect_stdout(log):
        fit(work, Path(folder) / "probe", TrainerOptions(seed=seed), {})
    reader.load_state_dict(best)


@torch.no_grad()
def read(reader: Reader, inputs_of: Callable[[Rows], Inputs], rows: Rows) -> Outputs:
    """Return a reader's raw outputs of some frames."""
    reader.eval()
    return torch.cat([reader.outputs(inputs_of(part)) for part in rows.split(BATCH)])
