"""Alignment of touch with frozen image and text towers (the MMWand paper, after ImageBind)."""

import copy
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from accelerate.utils import send_to_device
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from touchgoal.encoders import pretrained
from touchgoal.encoders.alignment.config import AlignConfig
from touchgoal.encoders.alignment.data import (
    TouchData,
    augment,
    prepare_touch_data,
    split_by_episode,
)
from touchgoal.encoders.alignment.infonce import info_nce, loss_floor, symmetric_info_nce
from touchgoal.encoders.alignment.retrieval import evaluate_retrieval
from touchgoal.encoders.alignment.touch_encoder import TouchEncoder, TouchEncoderConfig
from touchgoal.encoders.backbones.vit import PRESETS as VIT_PRESETS
from touchgoal.encoders.backbones.vit import ViTConfig, random_masking
from touchgoal.encoders.towers.towers import Towers
from touchgoal.encoders.training import trainer
from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.encoders.training.checkpoint import checksum
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.episodes.touches import Touches

_ENCODER = "encoder"


def align(
    train: Touches,
    val: Touches,
    towers: Towers,
    config: AlignConfig,
    sensor: str,
    out_dir: Path,
    options: TrainerOptions,
    recipe: dict[str, Any],
) -> TouchEncoder:
    """Train a touch encoder.

    Writes what `trainer.fit` does, and at the end the encoder to `encoder/`: that of the epoch with
    the best retrieval (mean of both mAPs) on one half of the validation episodes. Its retrieval on
    the other half, the test set, is stored as `test_metrics`. A killed and resumed run ends with
    the same weights as an uninterrupted one. Returns the encoder as saved in `out_dir/encoder`, in
    evaluation mode, on the CPU. UserError: unfit data, no such device, or a folder that does not
    fit `options.resume`.

    Args:
        val: Touches of other episodes.
        out_dir: A new run's folder, or one to resume.
        recipe: JSON-able provenance of the touches, stored with the weights.
    """
    data, val_data = (
        prepare_touch_data(t, towers, sensor, config.no_contact_texts) for t in (train, val)
    )
    choosing, test = split_by_episode(val_data, options.seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        encoder = TouchEncoder(
            TouchEncoderConfig.for_towers(find_vit(config), towers, sensor, config.embedding_dim)
        )
    loss, best = AlignmentLoss(encoder, config), copy.deepcopy(encoder)

    def update_best(history: list[dict[str, Any]], _: dict[str, Any]) -> None:
        if max(history, key=_score) is history[-1]:
            best.load_state_dict(encoder.state_dict())

    training = trainer.Training(
        loss=loss,
        n_samples=len(data),
        batch=lambda rows, noise: make_batch(data, rows, config, noise),
        optimizer=optimizer_config(config),
        identity={
            "align": asdict(config),
            "encoder": asdict(encoder.config),
            "data": [_checksum(train), _checksum(val)],
        },
        evaluate=lambda: evaluate_retrieval(encoder, choosing) | loss_and_floors(loss, data),
        progress=_progress,
        after_epoch=update_best,
        extra_state={"best": best},
    )
    history, provenance = trainer.fit(training, out_dir, options, recipe)
    encoder.load_state_dict(best.state_dict())
    provenance |= {
        "align": asdict(config),
        "touches": {"train": len(data), "val": len(val_data), "objects": list(data.names)},
        "metrics": max(history, key=_score),
        "test_metrics": evaluate_retrieval(encoder, test),
    }
    trainer.on_first_process(lambda: pretrained.save(encoder, out_dir / _ENCODER, provenance))
    return cast(TouchEncoder, pretrained.load_encoder(out_dir / _ENCODER))


def find_vit(config: AlignConfig) -> ViTConfig | None:
    """Return the ViT that a config names; None for EfficientNet."""
    return VIT_PRESETS.get(config.backbone.removeprefix("vit-"))


def optimizer_config(config: AlignConfig) -> trainer.OptimizerConfig:
    """Return the settings of the optimizer."""
    return trainer.OptimizerConfig(
        config.epochs,
        config.batch_size,
        config.lr,
        config.weight_decay,
        decoupled_weight_decay=config.optimizer == "adamw",
        warmup=config.warmup,
        final_lr=config.final_lr,
    )


def _checksum(touches: Touches) -> str:
    sentences = [s for name in sorted(touches.descriptions) for s in touches.descriptions[name]]
    return checksum(touches.frames, touches.view, touches.object, sentences)


@dataclass(frozen=True, eq=False)
class AlignedBatch:
    """b touches with their sentences and images, as unit vectors of the shared space."""

    touch: Float[Tensor, "b d"]  # touch embeddings
    text: Float[Tensor, "b d"]  # embedding of one sentence for each touch
    image: Float[Tensor, "b d"]  # embedding of one image each, meaningless without contact
    contact: Bool[Tensor, " b"]  # whether the touch has an image
    same: Bool[Tensor, "b b"]  # whether touches i and j have the same object or the same sentence


def make_batch(
    data: TouchData, rows: Int[Tensor, " b"], config: AlignConfig, noise: BatchNoise
) -> dict[str, Tensor | None]:
    """Return the arguments of `AlignmentLoss`: augmented, masked touches with sentences and images."""
    sentence = data.draw_sentences(rows, noise)
    touch, ids_keep = augment(data.touch[rows].float(), config.augmentation, noise), None
    if config.mask_ratio > 0 and (vit := find_vit(config)) is not None:
        masking = partial(random_masking, vit, config.mask_ratio)
        ids_keep = noise.draw(len(rows), masking)
    return {
        "touch": touch,
        "ids_keep": ids_keep,
        "text": data.texts[sentence],
        "image": data.images[data.view_index[rows]],
        "contact": data.contact[rows],
        "label": data.label[rows],
        "sentence": sentence,
    }


class AlignmentLoss(nn.Module):
    """A touch encoder and its contrastive loss over the batches of all processes."""

    def __init__(self, encoder: TouchEncoder, config: AlignConfig) -> None:
        super().__init__()
        self.encoder, self.config = encoder, config

    def forward(self, **batch: Tensor | None) -> dict[str, Float[Tensor, ""]]:
        """Return `batch_losses` of what `make_batch` returns, in float32 whatever the precision."""
        embedded = self.embed(batch, trainer.gather_batch)
        with torch.autocast(embedded.touch.device.type, enabled=False):
            return batch_losses(embedded, self.encoder.config.pretrained_together, self.config)

    def embed(
        self, batch: Mapping[str, Any], gather: Callable[[Tensor], Tensor] = lambda rows: rows
    ) -> AlignedBatch:
        """Embed a batch in the shared space; `gather` joins the rows of all processes."""
        touch = self.encoder.embed_touch(batch["touch"], batch["ids_keep"]).float()
        with torch.autocast(touch.device.type, enabled=False):
            text = self.encoder.project_text(batch["text"])
            image = self.encoder.project_image(batch["image"])
        label, sentence, contact = (
            gather(batch[k].long()) for k in ("label", "sentence", "contact")
        )
        return AlignedBatch(
            touch=gather(touch),
            text=gather(text),
            image=gather(image),
            contact=contact > 0,
            same=(label[:, None] == label) | (sentence[:, None] == sentence),
        )


def batch_losses(
    batch: AlignedBatch, pretrained_together: bool, config: AlignConfig
) -> dict[str, Float[Tensor, ""]]:
    """Return the weighted sum "loss" (the paper's Eq. 2) and its terms.

    Touches without contact have no image and take part in touch-text only. A batch with fewer than
    two touches in contact has no image terms. Image-text trains the heads of towers that were not
    pretrained together (offline); a CLIP skips it.
    """
    nce = symmetric_info_nce if config.symmetric else info_nce
    c, tau = batch.contact, config.temperature
    same = batch.same if config.multi_positive else None
    same_c = batch.same[c][:, c] if config.multi_positive else None
    terms = {"loss_touch_text": nce(batch.touch, batch.text, tau, same)}
    loss = config.text_weight * terms["loss_touch_text"]
    if c.sum() >= 2:
        terms["loss_touch_image"] = nce(batch.touch[c], batch.image[c], tau, same_c)
        loss = loss + terms["loss_touch_image"]
        if not pretrained_together:
            terms["loss_image_text"] = nce(batch.image[c], batch.text[c], tau, same_c)
            loss = loss + terms["loss_image_text"]
    else:
        loss = loss + 0 * batch.image.sum()  # with several processes every head needs a gradient
    return {"loss": loss} | terms


@torch.no_grad()
def loss_and_floors(loss: AlignmentLoss, data: TouchData) -> dict[str, float]:
    """Return the losses from touch on a fixed batch of `data`, and their lower bounds."""
    config, device = loss.config, loss.encoder.device
    rows = torch.linspace(0, len(data) - 1, min(config.batch_size, len(data))).long()
    made = make_batch(data, rows, config, BatchNoise(torch.Generator().manual_seed(0)))
    batch = loss.embed(send_to_device(made, device))
    c = batch.contact
    floors = {}
    for name, chosen, target in (("text", c | ~c, batch.text), ("image", c, batch.image)):
        if chosen.sum() < 2:
            continue
        right = batch.same[chosen][:, chosen] if config.multi_positive else None
        value = info_nce(batch.touch[chosen], target[chosen], config.temperature, right)
        floors[f"touch_to_{name}_loss"] = value.item()
        floors[f"touch_to_{name}_floor"] = loss_floor(target[chosen], config.temperature, right)
    return floors


def _score(metrics: dict[str, Any]) -> float:
    """Return the mean of the mAPs that are defined."""
    found = [metrics[f"touch_to_{other}_map"] for other in ("text", "image")]
    return float(np.mean([x for x in found if x is not None]))


def _progress(m: dict[str, Any]) -> str:
    image = m["touch_to_image_top1"]
    image = "not measured (one episode per object)" if image is None else f"{image:.1%}"
    return (
        f"loss {m['loss']:.3f}; touch to text {m['touch_to_text_loss']:.2f} (lower bound "
        f"{m['touch_to_text_floor']:.2f}); object retrieved by touch: among sentences "
        f"{m['touch_to_text_top1']:.1%}, among images {image} (chance {m['chance_top1']:.1%})"
    )
