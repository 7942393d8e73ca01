"""Train a touch encoder: on recorded episodes, aligned or without labels; on simulated surfaces; on videos."""

from pathlib import Path
from typing import Annotated, Any

import tyro
from pydantic import Field

from touchgoal.encoders.config import ALIGN_PRESETS, MAE_PRESETS, AlignConfig, MaeConfig
from touchgoal.encoders.ssl.config import (
    DINO_PRESETS,
    IJEPA_PRESETS,
    VJEPA_PRESETS,
    DinoConfig,
    IJepaConfig,
    VJepaConfig,
)
from touchgoal.launch.support.training_options import TrainingOptions, UnlabelledOptions
from touchgoal.runtime.option_types import (
    RARE,
    Count,
    CountOrNone,
    Fraction,
    Seed,
    checked_dataclass,
)


@checked_dataclass
class Align(TrainingOptions):
    """Align touch with frozen image and text networks (contrastive, as in MMWand)."""

    validation: Path
    """Set of other episodes, four or more of each object. Retrieval on one half of them chooses the
    best epoch, and is reported on the other half."""
    out: Path | None = None
    """Folder of the run; the encoder goes to its `encoder/`."""
    sensor: str | None = None
    """Fingertip sensor, for episodes that do not name theirs."""
    towers: str = "offline"
    """Frozen image and text towers: offline, or a CLIP as Hugging Face id or local directory."""
    contact_frames: Count = 24
    """Frames in contact taken from each episode."""
    no_contact_frames: CountOrNone = 8
    """Frames without contact taken from each episode."""
    normalizer_episodes: Count = 40
    """Successful training episodes whose distances to their goals fix what counts as far and as near
    in reward curves (encoder/normalizer.json)."""
    align: AlignConfig = ALIGN_PRESETS["default"]
    """How the encoder is trained."""


@checked_dataclass
class AlignPaper(Align):
    """Align with the training of the MMWand paper: ViT-H, 100 epochs, temperature 0.2, lambda 1."""

    align: AlignConfig = ALIGN_PRESETS["paper"]
    """How the encoder is trained."""


@checked_dataclass
class Mae(UnlabelledOptions):
    """Learn touch without labels, by masked autoencoding (MAE)."""

    frames: Count = 40
    """Moments drawn from each episode, both fingertips of each."""
    stride: Count = 2
    """Ticks between the two frames of a moment, with `stacked`."""
    mae: MaeConfig = MAE_PRESETS["default"]
    """How the encoder is trained."""


@checked_dataclass
class MaePaper(Mae):
    """MAE with the training of the Sparsh paper: ViT-B, two frames, 150 epochs; meant for large GPUs."""

    mae: MaeConfig = MAE_PRESETS["paper"]
    """How the encoder is trained."""


@checked_dataclass
class Distill(UnlabelledOptions):
    """Options of the objectives that see several frames at once."""

    frames: Count = 20
    """Moments drawn from each episode, both fingertips of each."""
    stride: Count = 2
    """Ticks between the frames of a moment: 2 are 0.1 s at 20 Hz, where Sparsh has 0.08 s (5 frames
    of a sensor at 60 Hz)."""


@checked_dataclass
class Dino(Distill):
    """Learn touch without labels from two frames, by self-distillation (DINO)."""

    dino: DinoConfig = DINO_PRESETS["default"]
    """How the encoder is trained."""


@checked_dataclass
class DinoPaper(Dino):
    """DINO with the training of the Sparsh paper: ViT-B, 150 epochs; meant for large GPUs."""

    dino: DinoConfig = DINO_PRESETS["paper"]
    """How the encoder is trained."""


@checked_dataclass
class IJepa(Distill):
    """Learn touch without labels from two frames, by predicting hidden blocks (I-JEPA)."""

    ijepa: IJepaConfig = IJEPA_PRESETS["default"]
    """How the encoder is trained."""


@checked_dataclass
class IJepaPaper(IJepa):
    """I-JEPA with the training of the Sparsh paper: ViT-B, 150 epochs; meant for large GPUs."""

    ijepa: IJepaConfig = IJEPA_PRESETS["paper"]
    """How the encoder is trained."""


@checked_dataclass
class VJepa(Distill):
    """Learn touch without labels from clips of four frames, by predicting hidden tubes (V-JEPA)."""

    frames: Count = 10
    """Moments drawn from each episode, both fingertips of each."""
    stride: Count = 1
    """Ticks between the frames of a clip: 1 is 0.05 s at 20 Hz, where Sparsh has 0.03 s (2 frames of
    a sensor at 60 Hz)."""
    vjepa: VJepaConfig = VJEPA_PRESETS["default"]
    """How the encoder is trained."""


@checked_dataclass
class VJepaPaper(VJepa):
    """V-JEPA with the training of the Sparsh paper: ViT-B, 150 epochs; meant for large GPUs."""

    vjepa: VJepaConfig = VJEPA_PRESETS["paper"]
    """How the encoder is trained."""


@checked_dataclass
class Surfaces:
    """Fit an ImageNet network to touch, on simulated presses of random surfaces: no episodes needed."""

    sensor: str = "gelsight_mini"
    """Sensor that is simulated: a name, or the folder of a sensor file."""
    surfaces: Annotated[int, Field(ge=16)] = 5000
    """Random surfaces."""
    presses_per_surface: Annotated[int, Field(ge=2)] = 4
    """Presses of each, on other units, places, turns and depths."""
    seed: Seed = 0
    """Random seed of surfaces, units and presses."""
    out: Path | None = None
    """Folder of the run; the encoder goes to its `encoder/`."""


@checked_dataclass
class Adapt:
    """Adapt an encoder that `surfaces` fitted to videos of things of your own, several of each."""

    data: Path
    """Folder with videos/ and labels.csv, as PhysiCLeAR has them; those of split train and unlabelled
    are taken. From ranks of hardness, roughness and bumpiness the encoder also learns sentences."""
    encoder: str = "gelsight_mini_surfaces"
    """Encoder to adapt: a name, or the folder of one."""
    towers: str = "offline"
    """Frozen towers whose sentences it learns: offline, or a CLIP as Hugging Face id or local directory."""
    share: Annotated[Fraction, RARE] = 0.1
    """Share of the videos in what counts as no difference; the rest is what simulation says. Chosen on
    PhysiCLeAR's training things, where 0.02 to 0.9 do alike."""
    out: Path | None = None
    """Folder of the run; the encoder goes to its `encoder/`."""


Config = (
    Annotated[Align, tyro.conf.subcommand("align")]
    | Annotated[AlignPaper, tyro.conf.subcommand("align-paper")]
    | Annotated[Mae, tyro.conf.subcommand("mae")]
    | Annotated[MaePaper, tyro.conf.subcommand("mae-paper")]
    | Annotated[Dino, tyro.conf.subcommand("dino")]
    | Annotated[DinoPaper, tyro.conf.subcommand("dino-paper")]
    | Annotated[IJepa, tyro.conf.subcommand("ijepa")]
    | Annotated[IJepaPaper, tyro.conf.subcommand("ijepa-paper")]
    | Annotated[VJepa, tyro.conf.subcommand("vjepa")]
    | Annotated[VJepaPaper, tyro.conf.subcommand("vjepa-paper")]
    | Annotated[Surfaces, tyro.conf.subcommand("surfaces")]
    | Annotated[Adapt, tyro.conf.subcommand("adapt")]
)


def main(config: Any) -> None:
    """Train one kind of encoder."""
    from touchgoal.launch.commands.train_encoder import run_command

    run_command(config)
