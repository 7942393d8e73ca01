"""Options of `train-encoder align`; light to import."""

from dataclasses import field
from pathlib import Path
from typing import Any, ClassVar, Literal

from touchgoal.encoders.alignment.config import ALIGN_PRESETS, AlignConfig
from touchgoal.encoders.training.options import SetTrainerOptions
from touchgoal.runtime.option_types import Count, checked_dataclass

Preset = Literal["default", "paper"]


def presets(option: str, configs: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return what each preset sets: the whole `option`."""
    return {name: {option: config} for name, config in configs.items()}


@checked_dataclass
class Align(SetTrainerOptions):
    """Align touch with frozen image and text networks by contrastive learning, as in MMWand."""

    PRESETS: ClassVar = presets("align", ALIGN_PRESETS)

    data: Path = field(kw_only=True)
    """Episodes or touches of the wand to train on, or the annotations.jsonl of `annotate`, with
    --sensor."""
    validation: Path | None = None
    """Other episodes (or another annotations.jsonl), at least four of each object. Retrieval on one half
    of them chooses the best epoch; the other half is the test set. Of touches of the wand a fifth of
    the visits is held out instead."""
    out: Path | None = None
    """Folder of the run; the encoder goes to its `encoder/`."""
    preset: Preset = "default"
    """Default hyperparameters: for two CPU cores, or the MMWand paper's (ViT-H, 100 epochs, temperature
    0.2, lambda 1). --align.* overrides them."""
    sensor: str | None = None
    """Fingertip sensor of episodes that do not name theirs."""
    towers: str = "offline"
    """Frozen image and text towers: offline, or a CLIP as Hugging Face id or local folder."""
    normalizer_episodes: Count = 40
    """Successful training episodes on which the normalizer is fitted (encoder/normalizer.json): it
    scales distances in reward curves to 1 at the usual start of an episode and 0 at its goal."""
    align: AlignConfig = ALIGN_PRESETS["default"]
    """Hyperparameters."""
