"""Touch encoders on disk, of either kind, checked against the sensor, the preprocessor and the towers."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from touchgoal.encoders.alignment.touch_encoder import TouchEncoder, TouchEncoderConfig
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder, PooledEncoderConfig
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone, TouchBackboneConfig
from touchgoal.encoders.backbones.vit import ViTConfig
from touchgoal.encoders.preprocess import preprocessor_for, steady_preprocessor_for
from touchgoal.encoders.published import is_published, load_published
from touchgoal.encoders.towers.towers import same_towers
from touchgoal.encoders.training.weights import WeightsFormat
from touchgoal.runtime.errors import UserError

AnyTouchEncoder = TouchEncoder | TouchBackbone | PooledEncoder
"""Aligned with images and texts; learned without labels; a whitened ImageNet network."""

_WEIGHTS = Path(__file__).parent / "weights"
DEFAULT_ENCODER = _WEIGHTS / "gelsight_mini_offline"
ENCODER_FORMAT = WeightsFormat(
    "encoder", "touch encoder", "train one with: touchgoal train-encoder"
)


def save(
    encoder: AnyTouchEncoder,
    directory: Path,
    provenance: dict[str, Any],
    half: bool = True,
) -> None:
    """Writes an encoder; an older one in the directory is replaced.

    Args:
        encoder: What to keep.
        directory: Made if needed.
        provenance: JSON-able: data, command, seed, metrics of the training.
        half: Store weights as float16, which turns embeddings by a cosine distance below 1e-3.
    """
    dtype = torch.float16 if half else torch.float32
    weights = {name: w.detach().cpu().to(dtype) for name, w in encoder.state_dict().items()}
    ENCODER_FORMAT.save(directory, weights, asdict(encoder.config), provenance)


def shipped_encoder_for(sensor: str | None) -> Path:
    """The encoder that ships for a sensor, on the offline towers; `DEFAULT_ENCODER` if it is unknown.

    Raises:
        UserError: none ships.
    """
    directory = _WEIGHTS / f"{sensor}_offline" if sensor else DEFAULT_ENCODER
    if not directory.is_dir():
        raise UserError(f"no touch encoder ships for {sensor}: {ENCODER_FORMAT.remedy}")
    return directory


def load_aligned(
    directory: Path, sensor: str | None = None, towers: str | None = None
) -> TouchEncoder:
    """Reads an encoder for inference, as float32 on the CPU.

    Args:
        directory: What `save` wrote, e.g. `DEFAULT_ENCODER`.
        sensor: Name of the sensor it is meant for, if that matters here.
        towers: `Towers.name` it is meant for, if that matters here.

    Raises:
        UserError: Nothing there, damaged, or not made for this sensor, these towers or this
            version of the preprocessor.
    """
    config = ENCODER_FORMAT.read_config(directory, _aligned_config)
    if towers is not None and not same_towers(towers, config.towers):
        raise UserError(
            f"the encoder in {directory} was trained with the towers {config.towers}, not {towers}: "
            "load those towers, or train an encoder with these"
        )
    _check_sensor(config, directory, sensor)
    encoder = TouchEncoder(config)
    ENCODER_FORMAT.load_weights(encoder, directory)
    return encoder


def load_touch_backbone(directory: Path, sensor: str | None = None) -> TouchBackbone:
    """Reads a self-supervised backbone for inference, as float32 on the CPU; UserError as `load_aligned`."""
    config = ENCODER_FORMAT.read_config(directory, _backbone_config)
    _check_sensor(config, directory, sensor)
    encoder = TouchBackbone(config)
    ENCODER_FORMAT.load_weights(encoder, directory)
    return encoder


def load_pooled(directory: Path, sensor: str | None = None) -> PooledEncoder:
    """Reads a whitened ImageNet network for inference, on the CPU; UserError as `load_aligned`."""
    config = ENCODER_FORMAT.read_config(directory, lambda fields: PooledEncoderConfig(**fields))
    _check_sensor(config, directory, sensor)
    encoder = PooledEncoder(config)
    ENCODER_FORMAT.load_weights(encoder, directory)
    return encoder


def encoder_names() -> list[str]:
    """Names of the encoders that ship, for `load_encoder` and `--encoder`."""
    return sorted(path.parent.name for path in _WEIGHTS.glob("*/encoder.json"))


def find_encoder(name_or_path: str | Path) -> Path:
    """The folder of an encoder: one that `save` wrote, or a shipped one by its name.

    Args:
        name_or_path: a folder; a name of `encoder_names`; or a sensor, for the one that ships for
            it on the offline towers.

    Raises:
        UserError: neither a folder nor a name.
    """
    name = str(name_or_path)
    for directory in (Path(name), _WEIGHTS / name, _WEIGHTS / f"{name}_offline"):
        if (directory / "encoder.json").is_file():
            return directory
    if is_published(name):
        raise UserError(
            f"{name} are published weights, and this takes a folder of ours: make one of them, see "
            "load_published in touchgoal.encoders.published"
        )
    if Path(name).is_dir():
        raise UserError(f"no touch encoder in {name}: {ENCODER_FORMAT.remedy}")
    raise UserError(
        f"there is no touch encoder '{name}': give the folder of one, or a name of those that "
        f"ship: {', '.join(encoder_names())}"
    )


def load_encoder(name_or_path: str | Path, sensor: str | None = None) -> AnyTouchEncoder:
    """A touch encoder of any kind, on the CPU, ready for `embed`; see `find_encoder`.

        encoder = load_encoder("gelsight_mini")
        embeddings = encoder.embed(pictures)  # uint8 (n, 240, 320, 3); the first one untouched

    Published Sparsh encoders, too: a file in their layout, a folder with one, or an id of Hugging Face such as
    "facebook/sparsh-dino-base"; see `published.load_published` for their options.

    Args:
        name_or_path: Which one.
        sensor: Name of the sensor it is meant for, if that matters here.

    Raises:
        UserError: no such encoder, or as `load_aligned` or `load_published`.
    """
    if is_published(name_or_path):
        return load_published(name_or_path)
    directory = find_encoder(name_or_path)
    config = ENCODER_FORMAT.read_json(directory).get("config", {})
    if "features" in config:
        return load_pooled(directory, sensor)
    load = load_aligned if "towers" in config else load_touch_backbone
    return load(directory, sensor)


def _check_sensor(
    config: TouchEncoderConfig | TouchBackboneConfig | PooledEncoderConfig,
    directory: Path,
    sensor: str | None,
) -> None:
    if sensor is not None and config.sensor not in (None, sensor):
        raise UserError(
            f"the encoder in {directory} is for {config.sensor}, not {sensor}: {ENCODER_FORMAT.remedy}"
        )
    if isinstance(config, PooledEncoderConfig):
        current = steady_preprocessor_for(config.sensor).id
    elif config.sensor is None:  # of Sparsh: made for what the config names
        return
    else:
        current = preprocessor_for(config.sensor).id
    if config.preprocessor != current:
        raise UserError(
            f"the encoder in {directory} needs the preprocessor {config.preprocessor}, this is "
            f"{current}: {ENCODER_FORMAT.remedy}"
        )


def _aligned_config(fields: dict[str, Any]) -> TouchEncoderConfig:
    return TouchEncoderConfig(**_with_vit(fields))


def _backbone_config(fields: dict[str, Any]) -> TouchBackboneConfig:
    return TouchBackboneConfig(**_with_vit(fields))


def _with_vit(fields: dict[str, Any]) -> dict[str, Any]:
    vit = fields["vit"]
    size: dict[str, Any] = {"image_size": tuple(vit["image_size"])}
    return fields | {"vit": ViTConfig(**vit | size)}
