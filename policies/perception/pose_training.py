"""Training of the pose estimator on rendered placements."""

from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor, nn

from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.encoders.training.checkpoint import checksum
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.encoders.training.trainer import OptimizerConfig, Training, fit
from touchgoal.policies.config import Box, PoseEstimatorConfig, PoseTrainConfig
from touchgoal.policies.perception.placements import Placements
from touchgoal.policies.perception.pose_estimator import PoseEstimator, evenly_lit
from touchgoal.policies.perception.target_words import WORDS_WIDTH, embed

_HUBER_BETA = 0.3  # standard deviations beyond which an error of the pose counts linearly
_FINDER_ROWS = 4  # the first look, which learns faster, is trained on one of so many samples
_WORD_NOISE = 0.015  # standard deviation of each number of a sentence's embedding of length 1
_PLACE_NOISE = 8.0  # px by which crops are off in training: a cell of the first look
_PIXEL_NOISE = 4  # largest change of a pixel by simulated camera noise, grey levels
_BATCH = 64
_BAD, _FALSE_REFUSALS = (0.02, 20.0), 0.02  # m and degrees by which an estimate is off; share


def train_pose_estimator(
    estimator: PoseEstimator,
    placements: Placements,
    config: PoseTrainConfig,
    out_dir: Path,
    options: TrainerOptions,
    recipe: dict[str, Any],
) -> None:
    """Train the pose estimator; writes what `trainer.fit` does."""
    there = torch.arange(placements.start.shape[1]) < placements.objects[:, None]
    # Rounded: the tilt that inverse kinematics leaves is no information, and the network would react
    # to a real hand that is tilted by a thousandth.
    estimator.tcp_normalizer.fit_mean_std(placements.tcp.round(decimals=4))
    estimator.start_normalizer.fit_mean_std(placements.start[there])
    embedded = embed(placements.sentences) if placements.sentences else torch.empty(0, WORDS_WIDTH)

    def batch(rows: Tensor, noise: BatchNoise) -> dict[str, Any]:
        target = (noise.rand((len(rows),)) * placements.objects[rows]).long()
        words, unambiguous = _words(placements, embedded, rows, target, noise)
        return {
            "images": evenly_lit(
                {
                    key: _add_pixel_noise(placements.images[key][rows], box, noise)
                    for key, box in estimator.config.crops
                }
            ),
            "tcp": placements.tcp[rows],
            "shift": placements.shift[rows],
            "start": placements.start[rows, target],
            "places": {  # px, of the target and of the goal
                key: torch.stack([pixels[rows, target], pixels[rows, -1]], 1)
                for key, pixels in placements.pixels.items()
            },
            "words": words,
            "unambiguous": unambiguous,
            "off": _PLACE_NOISE * (2 * noise.rand((len(rows), 2, 2)) - 1),
        }

    tensors = (*placements.images.values(), *placements.pixels.values())
    training = Training(
        loss=_PoseLoss(estimator),
        n_samples=len(placements),
        batch=batch,
        optimizer=OptimizerConfig(
            config.epochs, config.batch_size, config.lr, weight_decay=1e-4, max_warmup_steps=50
        ),
        identity={
            "train": asdict(config),
            "pose_estimator": asdict(estimator.config),
            "data": checksum(
                *tensors, placements.tcp, placements.shift, placements.start, placements.sentence
            ),
        },
        progress=lambda m: f"pose: loss {m['pose']:.4f}, first look {m['find']:.3f}",
    )
    fit(training, out_dir, options, recipe)
    estimator.cpu()


class _PoseLoss(nn.Module):
    def __init__(self, estimator: PoseEstimator) -> None:
        super().__init__()
        self.estimator = estimator

    def forward(
        self,
        images: dict[str, Tensor],
        tcp: Tensor,
        shift: Tensor,
        start: Tensor,
        places: dict[str, Tensor],
        words: Tensor,
        unambiguous: Tensor,
        off: Tensor,
    ) -> dict[str, Tensor]:
        near = {key: place + off for key, place in places.items()}
        scene = self.estimator.scene(images, tcp, shift)
        predicted = self.estimator.scaled(images, scene, near)
        target = self.estimator.start_normalizer(start)
        pose = F.smooth_l1_loss(predicted, target, beta=_HUBER_BETA)
        few = slice(None, None, _FINDER_ROWS)  # the same rows in one process and in several
        scores = self.estimator.scores({k: p[few] for k, p in images.items()}, words[few])
        shares = self.estimator.place_shares({k: p[few] for k, p in places.items()})
        find = torch.stack(
            [_find_loss(scores[k], shares[k], unambiguous[few]) for k in scores]
        ).sum()
        mirrored = {key: image[few].flip(2) for key, image in images.items()}
        seen = scene[few], self.estimator.scene(mirrored, tcp[few], shift[few])
        logits = torch.cat([self.estimator.unmirrored(s)[:, 0] for s in seen])
        left = F.binary_cross_entropy_with_logits(
            logits, (torch.arange(len(logits)) < len(seen[0])).to(logits)
        )
        return {"loss": pose + find + left / 4, "pose": pose, "find": find, "mirrored": left}


def _find_loss(
    scores: Float[Tensor, "b 2 y x"],
    shares: Float[Tensor, "b 2 y x"],
    unambiguous: Bool[Tensor, " b"],
) -> Float[Tensor, ""]:
    """Return the cross-entropy of the goal, and of unambiguous objects."""
    entropy = -(scores.flatten(2).log_softmax(2) * shares.flatten(2)).sum(2)
    return (entropy[:, 0] * unambiguous).mean() + entropy[:, 1].mean()


def _words(
    placements: Placements,
    embedded: Float[Tensor, "n d"],
    rows: Int64[Tensor, " b"],
    target: Int64[Tensor, " b"],
    noise: BatchNoise,
) -> tuple[Float[Tensor, "b d"], Bool[Tensor, " b"]]:
    """Return the embedded sentences of the targets, and whether each identifies its target.

    Half of the targets that stand alone get no sentence.
    """
    sentences, alone = placements.sentence[rows, target], placements.objects[rows] == 1
    silent = (sentences < 0) | (alone & (noise.rand((len(rows),)) < 0.5))
    jitter = _WORD_NOISE * noise.randn((len(rows), WORDS_WIDTH))
    words = torch.zeros(len(rows), WORDS_WIDTH)
    words[~silent] = embedded[sentences[~silent]] + jitter[~silent]
    return words, alone | (sentences >= 0)


def _add_pixel_noise(
    images: UInt8[Tensor, "b h w 3"], box: Box, noise: BatchNoise
) -> UInt8[Tensor, "b h w 3"]:
    """Change the images in the box, and return them."""
    top, bottom, left, right = box
    crop = images[:, top:bottom, left:right]
    added = noise.draw(
        len(crop),
        lambda n, g: torch.randint(
            -_PIXEL_NOISE, _PIXEL_NOISE + 1, (n, *crop.shape[1:]), dtype=torch.int16, generator=g
        ),
    )
    crop.copy_((crop + added).clamp(0, 255))
    return images


@torch.no_grad()
def fit_trust(
    estimator: PoseEstimator, placements: Placements
) -> tuple[PoseEstimatorConfig, dict[str, float]]:
    """Return the config with `sure` and `misfit`, and the shares of good and bad estimates refused.

    Each number of `sure` refuses a quarter of the 2 % of good estimates that it may refuse, `misfit` 2 % of
    those with a sentence; a bad one is off by 2 cm or 20 degrees. Only objects that a sentence identifies, or
    that stand alone, count. The estimator's known objects are fitted, too.
    """
    sure, good, named, found = ([] for _ in range(4))
    for rows, target, words in _targets(placements):
        start, sureness, *likeliest = _look(estimator, placements, rows, words)
        true = placements.start[rows, target]
        sure.append(sureness)
        named.append(words.any(1))
        found.append(likeliest)
        off = (start - true)[:, :2].norm(dim=1)
        good.append((off < _BAD[0]) & (_yaw_error(start, true) < _BAD[1]))
    shares, fine, said = (torch.cat(some) for some in (sure, good, named))
    asked, objects = (torch.cat(some) for some in zip(*found, strict=True))
    if not fine.any():  # no threshold
        return estimator.config, {"good": 0.0, "bad": 0.0}
    least = shares[fine].quantile(_FALSE_REFUSALS / shares.shape[1], dim=0)
    refused = (shares < least).any(1)
    config = replace(estimator.config, sure=(*least.tolist(),))
    if (fine & said).any():
        estimator.known.fit(objects[fine])
        misfit = estimator.misfit(asked, objects)
        limit = misfit[fine & said].quantile(1 - _FALSE_REFUSALS).item()
        config, refused = replace(config, misfit=limit), refused | ((misfit > limit) & said)
    known = {"good": refused[fine].float().mean().item()}
    known["bad"] = refused[~fine].sum().item() / max(int((~fine).sum()), 1)
    return config, known


@torch.no_grad()
def pose_errors(estimator: PoseEstimator, placements: Placements) -> dict[str, dict[str, Any]]:
    """Return the errors by number of other objects; alone, without a sentence.

    `found` is the share of the objects found within 3 cm. The others are median and 90th
    percentile: of the object's and the goal's position on the table (mm), of the object's height
    (mm), and of the grasp's yaw (degrees) for objects that are not round.
    """
    errors = {}
    for rows, target, words in _targets(placements):
        predicted = _look(estimator, placements, rows, words)[0]
        true = placements.start[rows, target]
        off = predicted - true
        away = 1e3 * off[:, :2].norm(dim=1)
        by_name = {
            "object_mm": away,
            "goal_mm": 1e3 * off[:, 5:].norm(dim=1),
            "height_mm": 1e3 * off[:, 2].abs(),
            # round objects are grasped at 0 exactly
            "yaw_degrees": _yaw_error(predicted, true)[true[:, 4] != 0],
        }
        at = torch.tensor([0.5, 0.9])
        found = {"count": len(rows), "found": (away < 30).float().mean().item()}
        errors[f"{int(placements.objects[rows[0]]) - 1} others"] = found | {
            name: error.quantile(at).tolist() for name, error in by_name.items() if len(error)
        }
    return errors


def _targets(
    placements: Placements,
) -> Iterator[tuple[Int64[Tensor, " n"], Int64[Tensor, " n"], Float[Tensor, "n d"]]]:
    """Yield rows, target of each, and its embedded sentence, by number of other objects.

    Where it is alone there is none.
    """
    for others in range(placements.start.shape[1]):
        named = placements.sentence >= 0
        if others == 0:
            named = torch.arange(named.shape[1]) == torch.zeros(len(named), 1)
        rows = ((placements.objects == others + 1) & named.any(1)).nonzero()[:, 0]
        if len(rows):
            target = named[rows].int().argmax(1)
            words = torch.zeros(len(rows), WORDS_WIDTH)
            if others:
                sentences = placements.sentence[rows, target]
                words = embed([placements.sentences[i] for i in sentences])
            yield rows, target, words


def _look(
    estimator: PoseEstimator,
    placements: Placements,
    rows: Int64[Tensor, " n"],
    words: Float[Tensor, "n d"],
) -> tuple[Float[Tensor, "n _"], ...]:
    """Return start and sureness of each `Look`, and what is `likeliest`."""
    looks = []
    for some, chosen in zip(rows.split(_BATCH), words.split(_BATCH), strict=True):
        lit = evenly_lit({key: images[some] for key, images in placements.images.items()})
        scene = estimator.scene(lit, placements.tcp[some], placements.shift[some])
        look, likeliest = estimator.look(lit, chosen, scene), estimator.likeliest(lit, chosen)
        looks.append((look.start, look.sureness, *likeliest))
    return tuple(torch.cat(parts) for parts in zip(*looks, strict=True))


def _yaw_error(predicted: Float[Tensor, "n 7"], true: Float[Tensor, "n 7"]) -> Float[Tensor, " n"]:
    """Return the errors of the grasp's yaw, degrees."""
    twice = torch.atan2(predicted[:, 4], predicted[:, 3]) - torch.atan2(true[:, 4], true[:, 3])
    return torch.rad2deg(torch.atan2(twice.sin(), twice.cos()) / 2).abs()


def error_table(errors: dict[str, dict[str, Any]]) -> str:
    """Return a line for each number of other objects: medians, and 90th percentiles in brackets."""
    names = ("object_mm", "goal_mm", "height_mm", "yaw_degrees")
    lines = [f"{'':<10}{'found':>7}" + "".join(f"{n.replace('_', ', '):>16}" for n in names)]
    for what, row in errors.items():
        cells = [row.get(name) for name in names]
        shown = [f"{c[0]:.1f} ({c[1]:.1f})" if c else "-" for c in cells]
        lines.append(f"{what:<10}{row['found']:>7.2f}" + "".join(f"{s:>16}" for s in shown))
    return "\n".join(lines)
