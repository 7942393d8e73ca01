"""Validation of a self-supervised backbone after every epoch, because its loss says little."""

from collections.abc import Callable

import torch
from accelerate.utils import send_to_device
from jaxtyping import Float
from torch import Tensor

from touchgoal.encoders.backbones.touch_backbone import BATCH
from touchgoal.encoders.backbones.vit import patchify
from touchgoal.encoders.ssl.frames import TouchFrames
from touchgoal.encoders.ssl.self_distillation import SelfDistillation

_PROBE_SAMPLES, _TOKEN_SAMPLES = 2048, 128
_STRENGTH = 1e-3  # of a ridge, as a share of the number of samples
_LEAST_SPREAD, _LEAST_RANK = 0.01, 0.05  # shares of the untrained spread, and rank above 1
_LEAST_INFORMATION = 0.01  # nats


class Validation:
    """Metrics of a training's teacher on touches of other episodes."""

    def __init__(self, model: SelfDistillation, train: TouchFrames, val: TouchFrames) -> None:
        """Measure the untrained backbone, to which collapse is relative."""
        self._model, self._train, self._val = model, train, val
        self._untrained = token_statistics(self._tokens(val))

    def metrics(self) -> dict[str, float]:
        """Return the loss, `token_statistics`, `reconstruction` and `read_forces`.

        `reconstruction` is the explained share of the image's mean square when a linear decoder,
        fitted to training tokens, predicts each patch from its own token.
        """
        tokens, pixels = self._tokens(self._val), self._pixels(self._val)
        error = (self._decode(tokens) - pixels).square().mean() / pixels.square().mean()
        return {
            "validation_loss": self._loss(),
            **token_statistics(tokens),
            **{f"{name}_untrained": value for name, value in self._untrained.items()},
            "reconstruction": 1 - error.item(),
            **read_forces(self._embed, self._train, self._val),
        }

    def has_collapsed(self, metrics: dict[str, float]) -> bool:
        """Return whether touches no longer differ, differ along one line, or share one prototype."""
        spread = metrics["token_spread"] / max(self._untrained["token_spread"], 1e-12)
        rank = (metrics["effective_rank"] - 1) / max(self._untrained["effective_rank"] - 1, 1e-12)
        information = metrics.get("teacher_information", 1.0)
        return not (
            spread >= _LEAST_SPREAD and rank >= _LEAST_RANK and information >= _LEAST_INFORMATION
        )

    def line(self, metrics: dict[str, float]) -> str:
        """Return the line to print for an epoch."""
        text = (
            f"loss {metrics['loss']:.4f} in training, {metrics['validation_loss']:.4f} in validation; "
            f"token spread {metrics['token_spread']:.3f} ({self._untrained['token_spread']:.3f} "
            f"untrained) in {metrics['effective_rank']:.1f} dimensions; "
            f"{metrics['reconstruction']:.2f} of the image reconstructed{forces_line(metrics)}"
        )
        warning = "  WARNING: the embeddings have collapsed, all touches have the same one"
        return text + warning if self.has_collapsed(metrics) else text

    @torch.no_grad()
    def _loss(self) -> float:
        generator, total = torch.Generator().manual_seed(0), 0.0
        device = self._model.teacher.device
        for touch in self._val.touch.split(BATCH):
            drawn = self._model.draw(len(touch), generator)
            batch = send_to_device({"touch": touch, **drawn}, device)
            total += self._model(**batch)["loss"].item() * len(touch)
        return total / len(self._val)

    def _embed(self, touch: Tensor) -> Tensor:
        return self._of_batches(touch, self._model.teacher.embed_touch)

    def _tokens(self, data: TouchFrames) -> Float[Tensor, "n p d"]:
        return self._of_batches(_sample(data), self._model.teacher.vit)

    @torch.no_grad()
    def _of_batches(self, touch: Tensor, network: Callable[[Tensor], Tensor]) -> Tensor:
        teacher = self._model.teacher
        batches = touch.split(BATCH)
        stacked = (teacher.stack(b.to(teacher.device).float()) for b in batches)
        return torch.cat([network(images).float().cpu() for images in stacked])

    def _pixels(self, data: TouchFrames) -> Float[Tensor, "n p c"]:
        """Return the pixels of the newest frame's patches."""
        return patchify(_sample(data)[:, 0].float(), self._model.teacher.config.vit)

    def _decode(self, tokens: Float[Tensor, "m p d"]) -> Float[Tensor, "m q c"]:
        """Decode the newest frame's patches, each from its own token, by a ridge."""
        known, pixels = self._tokens(self._train), self._pixels(self._train)
        count = pixels.shape[1]  # a clip's first tokens are those of the newest tubelet
        X, Y = known[:, :count].flatten(0, 1), pixels.flatten(0, 1)
        mean, offset = X.mean(0), Y.mean(0)
        X = X - mean
        ridge = _STRENGTH * len(X) * X.var() * torch.eye(X.shape[1])
        weights = torch.linalg.solve(X.T @ X + ridge, X.T @ (Y - offset))
        return (tokens[:, :count] - mean) @ weights + offset


def token_statistics(tokens: Float[Tensor, "n p d"]) -> dict[str, float]:
    """Measure how touches differ in their tokens.

    The mean over touches is subtracted at each place first: position codes make the tokens of one
    touch differ even at collapse. Returns `token_spread`, the mean square of the difference divided
    by that of the tokens: 0 if all touches are equal; `effective_rank`, the exponential of the
    entropy of the difference's spectrum (Roy and Vetterli 2007): the number of dimensions in which
    touches differ.
    """
    apart = (tokens - tokens.mean(0)).double()
    spread = apart.square().mean() / tokens.double().square().mean()
    rows = apart.flatten(0, 1)
    spectrum = torch.linalg.eigvalsh(rows.T @ rows).clamp(min=0)
    shares = spectrum / spectrum.sum().clamp(min=1e-300)
    return {
        "token_spread": spread.item(),
        "effective_rank": torch.special.entr(shares).sum().exp().item(),
    }


def read_forces(
    embed: Callable[[Tensor], Tensor], train: TouchFrames, val: TouchFrames
) -> dict[str, float]:
    """Return `force_x_r2`, `force_y_r2` (shear along columns and rows), `force_z_r2`.

    Shares of the variance that a linear probe fitted on 2,048 training touches explains; nothing
    without recorded forces.
    """
    if train.wrench is None or val.wrench is None:
        return {}
    rows = torch.linspace(0, len(train) - 1, min(_PROBE_SAMPLES, len(train))).long()
    inputs = embed(train.touch[rows])
    r2 = ridge_r2(inputs, train.wrench[rows, :3], embed(val.touch), val.wrench[:, :3])
    return {f"force_{axis}_r2": value.item() for axis, value in zip("xyz", r2, strict=True)}


def forces_line(metrics: dict[str, float]) -> str:
    """Return the result of `read_forces` for an epoch's line; "" without forces."""
    if "force_x_r2" not in metrics:
        return ""
    forces = [f"{axis} {metrics[f'force_{axis}_r2']:.2f}" for axis in "xyz"]
    return f"; R2 of the force read from the embedding: {', '.join(forces)}"


def _sample(data: TouchFrames) -> Tensor:
    """Return evenly spaced touches."""
    rows = torch.linspace(0, len(data) - 1, min(_TOKEN_SAMPLES, len(data))).long()
    return data.touch[rows]


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
