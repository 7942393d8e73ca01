"""Train a touch encoder on recorded episodes: align it with frozen towers, or by masking alone."""

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from tqdm import tqdm

from touchgoal.control.errors import UserError
from touchgoal.encoders.alignment.align import PRESETS, AlignConfig, align
from touchgoal.encoders.ssl import frames as touch_frames
from touchgoal.encoders.ssl.mae import MaeConfig, train_mae
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.episodes.store import EpisodeSet
from touchgoal.episodes.touches import collect_touches
from touchgoal.launch.run_folder import open_run
from touchgoal.rewards.embedding_distance import EpisodeEmbedder
from touchgoal.rewards.fit_normalizer import fit_normalizer
from touchgoal.rewards.normalizer import scene_of


@dataclass(frozen=True)
class Align:
    """Options of train-encoder align."""

    data: Path
    """Set of episodes to learn from."""
    validation: Path
    """Set of other episodes, by which the best epoch is chosen."""
    out: Path | None = None
    """Folder of the run; the encoder goes to its `encoder/`."""
    towers: str = "offline"
    """Frozen image and text towers: offline, or a CLIP as Hugging Face id or local directory."""
    contact_frames: int = 24
    """Frames in contact taken from each episode."""
    no_contact_frames: int = 8
    """Frames without contact taken from each episode."""
    scale_episodes: int = 40
    """Successful training episodes that fix the scale of the costs (encoder/scale.json)."""
    resume: bool = False
    """Go on with an interrupted run in `out`."""
    align: AlignConfig = PRESETS["default"]
    """The training."""


@dataclass(frozen=True)
class AlignPaper(Align):
    """The same with the paper's training: ViT-H, 100 epochs, temperature 0.2, lambda 1."""

    align: AlignConfig = PRESETS["paper"]
    """The training."""


@dataclass(frozen=True)
class Mae:
    """Options of train-encoder mae."""

    data: Path
    """Set of episodes to learn from."""
    validation: Path
    """Set of other episodes, on which losses are measured."""
    out: Path | None = None
    """Folder of the run; the backbone goes to its `encoder/`."""
    frames: int = 40
    """Ticks drawn from each episode, both fingertips of each."""
    resume: bool = False
    """Go on with an interrupted run in `out`."""
    mae: MaeConfig = MaeConfig()
    """The training."""


Config = (
    Annotated[Align, tyro.conf.subcommand("align")]
    | Annotated[AlignPaper, tyro.conf.subcommand("align-paper")]
    | Annotated[Mae, tyro.conf.subcommand("mae")]
)


def main(config: Align | Mae) -> None:
    """Train one kind of encoder."""
    if config.resume and config.out is None:
        raise UserError("to resume a run, name its folder with --out")
    if isinstance(config, Mae):
        _train_mae(config)
    else:
        _align(config)


def _train_mae(config: Mae) -> None:
    sets = EpisodeSet(config.data), EpisodeSet(config.validation)
    out = open_run(config.out, "train-encoder", config, adds=config.resume)
    mae = config.mae
    train, val = (touch_frames.sample_frames(s, mae.sensor, config.frames, mae.seed) for s in sets)
    train_mae(train, val, mae, out, _recipe(*sets), config.resume)
    print(f"backbone: {out / 'encoder'}")


def _recipe(episodes: EpisodeSet, validation: EpisodeSet) -> dict[str, Any]:
    return {
        "command": shlex.join(["touchgoal", *sys.argv[1:]]),
        "data": "simulated: touchgoal collect-demos",
        "episodes": len(episodes),
        "validation_episodes": len(validation),
    }


def _align(config: Align) -> None:
    """Cut touches from the episodes, train, fit the scale of the costs."""
    episodes, validation = EpisodeSet(config.data), EpisodeSet(config.validation)
    for s in (episodes, validation):
        for i in range(len(s)):
            touch_frames.check_sensor(s, i, config.align.sensor)
    towers = load_towers(config.towers)
    out = open_run(config.out, "train-encoder", config, adds=config.resume)
    train, val = (
        collect_touches(s, config.contact_frames, config.no_contact_frames, config.align.seed)
        for s in (episodes, validation)
    )
    print(f"{len(train)} touches of {len(train.descriptions)} objects; {len(val)} for validation")
    recipe = _recipe(episodes, validation)
    encoder = align(train, val, towers, config.align, out, recipe, config.resume)
    embedder = EpisodeEmbedder(towers, encoder)
    chosen = [i for i in range(len(episodes)) if episodes.meta(i).get("success", True)]
    embedded = [
        embedder.embed_episode(episodes.read(i), episodes.fps, f"{episodes.root}#{i}", True)
        for i in tqdm(chosen[: config.scale_episodes], desc="scale", unit="episode")
    ]
    scale = fit_normalizer(embedded, ("image", "tactile", "text"), scene_of(episodes.features))
    scale.save(out / "encoder" / "scale.json")
    print(f"encoder and scale: {out / 'encoder'}")
