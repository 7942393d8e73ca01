"""The three kinds of data that `train-encoder align` takes, and what it does with each."""

from pathlib import Path

from touchgoal.encoders.alignment.align import align
from touchgoal.encoders.alignment.wand_set import WandSet, is_wand_set
from touchgoal.encoders.annotation.records import open_annotations
from touchgoal.encoders.ssl.frames import find_sensor_name
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.encoders.training.run import check_run, open_sets, open_training, recipe
from touchgoal.encoders.training.trainer import is_first_process
from touchgoal.episodes.keys import parse_keys
from touchgoal.episodes.touches import collect_touches
from touchgoal.launch.support.align_options import Align
from touchgoal.rewards.distance.fit_normalizer import fit_normalizer
from touchgoal.rewards.distance.normalizer import NORMALIZER, scene_of
from touchgoal.rewards.features.embedder import EpisodeEmbedder
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track
from touchgoal.runtime.provenance import provenance

_CONTACT_FRAMES, _NO_CONTACT_FRAMES = 24, 8  # taken from each episode


def align_touch(config: Align) -> None:
    """Check episodes, touches of the wand or annotations, and align a touch encoder on them."""
    check_run(config, config.out)
    keys = parse_keys(config.keys)
    if config.data.suffix != ".jsonl" and is_wand_set(config.data, keys):
        _align_wand(config)
        return
    if config.validation is None:
        raise UserError("only touches of the wand are split automatically: give --validation")
    if config.data.suffix == ".jsonl":
        _align_annotated(config, config.validation)
        return
    data, validation = open_sets(config.data, config.validation, keys)
    sensor = find_sensor_name(config.sensor, data, validation)
    successes = [i for i in range(len(data)) if data.meta(i).get("success") is True]
    if not successes:
        raise UserError(
            f"no episode of {data.root} is marked as a success, and the normalizer of reward curves is "
            "fitted on successes: record some, or set `success` in their meta"
        )
    towers = load_towers(config.towers)
    out = open_training(config, "train-encoder")
    drawn = _CONTACT_FRAMES, _NO_CONTACT_FRAMES, config.seed
    train, val = (collect_touches(episodes, *drawn) for episodes in (data, validation))
    print(f"{len(train)} touches of {len(train.descriptions)} objects; {len(val)} for validation")
    made_from = recipe(data, validation)
    encoder = align(train, val, towers, config.align, sensor, out, config, made_from)
    if not is_first_process():
        return
    embedder = EpisodeEmbedder(towers, encoder)
    embedded = [
        embedder.describe(
            embedder.embed_chunks([data.read(i)], data.fps, f"{data.root}#{i}"), data.meta(i)
        )
        for i in track(successes[: config.normalizer_episodes], "normalizer", "episode")
    ]
    normalizer = fit_normalizer(embedded, ("image", "tactile", "text"), scene_of(data.features))
    normalizer.save(out / "encoder" / NORMALIZER)
    print(f"encoder and normalizer: {out / 'encoder'}")


def _align_wand(config: Align) -> None:
    """Align on touches of the wand; there are no successful episodes to fit a normalizer on."""
    if config.validation is not None:
        raise UserError(f"{config.data} holds touches of the wand: leave --validation out")
    data = WandSet.open(config.data)
    sensor, towers = find_sensor_name(config.sensor, data.episodes), load_towers(config.towers)
    rows, held_out = data.hold_out_visits(config.seed)
    out = open_training(config, "train-encoder")
    print(f"{len(rows)} touches of {len(data.names)} objects; {len(held_out)} held out")
    source = {"data": str(config.data), "checksum": data.episodes.checksum, **provenance()}
    train, test = data.touches(rows), data.touches(held_out)
    align(train, test, towers, config.align, sensor, out, config, source)
    print(f"encoder: {out / 'encoder'}")


def _align_annotated(config: Align, validation: Path) -> None:
    """Align on the annotations of `annotate`; without successful episodes no normalizer is fitted."""
    train, val = open_annotations(config.data, validation, config.sensor)
    towers = load_towers(config.towers)
    out = open_training(config, "train-encoder")
    print(f"{len(train)} touches of {len(train.descriptions)} captions; {len(val)} for validation")
    source = {"data": str(config.data), "validation": str(validation), **provenance()}
    assert config.sensor is not None  # open_annotations has checked it
    align(train, val, towers, config.align, config.sensor, out, config, source)
    print(f"encoder: {out / 'encoder'}")
