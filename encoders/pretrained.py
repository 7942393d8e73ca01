"""Touch encoders on disk: saved with their kind, found by name or path, loaded with strict checks."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from touchgoal.encoders.alignment.touch_encoder import TouchEncoder, TouchEncoderConfig
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder, PooledEncoderConfig
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone, TouchBackboneConfig
from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.encoders.published import find_published, load_published
from touchgoal.encoders.training.weights import WeightsFormat
from touchgoal.runtime.errors import UserError

AnyTouchEncoder = TouchEncoder | TouchBackbone | PooledEncoder
"""Aligned with images and texts; trained without labels; a whitened ImageNet network."""

_WEIGHTS = Path(__file__).parent / "weights"
DEFAULT_ENCODER = _WEIGHTS / "gelsight_mini"
ENCODER_FORMAT = WeightsFormat(
    "encoder", "touch encoder", "train one with: touchgoal train-encoder"
)
_CONFIGS: dict[str, Any] = {
    "aligned": TouchEncoderConfig,
    "backbone": TouchBackboneConfig,
    "whitened": PooledEncoderConfig,
}
"""The `kind` in an encoder's JSON file, and the class of its config."""


def save(
    encoder: AnyTouchEncoder, directory: Path, provenance: dict[str, Any], half: bool = True
) -> None:
    """Save an encoder; an older one in the folder is replaced.

    Args:
        directory: Folder, made if needed.
        provenance: JSON-able data, command, seed and metrics of the training.
        half: Store weights as float16, which turns embeddings by a cosine distance below 1e-3.
    """
    dtype = torch.float16 if half else torch.float32
    weights = {name: w.detach().cpu().to(dtype) for name, w in encoder.state_dict().items()}
    kind = next(kind for kind, made in _CONFIGS.items() if isinstance(encoder.config, made))
    config = {"kind": kind, **asdict(encoder.config)}
    ENCODER_FORMAT.save(directory, weights, config, provenance)


def shipped_encoder_for(sensor: str | None) -> Path:
    """Return the shipped encoder for a sensor, on the offline towers; the default one for None.

    UserError: none ships.
    """
    directory = _WEIGHTS / sensor if sensor else DEFAULT_ENCODER
    if not directory.is_dir():
        raise UserError(f"no touch encoder ships for {sensor}: {ENCODER_FORMAT.remedy}")
    return directory


def encoder_names() -> list[str]:
    """Return the names of the shipped encoders, for `load_encoder` and `--encoder`."""
    return sorted(path.parent.name for path in _WEIGHTS.glob("*/encoder.json"))


def find_encoder(name_or_path: str | Path, published: bool = True) -> Path:
    """Return the folder of an encoder of ours, or the file of a published one.

    UserError: no such encoder, or a published one where it is not accepted.

    Args:
        name_or_path: A folder; a name of `encoder_names`, such as a sensor's; published Sparsh
            weights, as file, folder or Hugging Face id.
    """
    name = str(name_or_path)
    for directory in (Path(name), _WEIGHTS / name):
        if (directory / "encoder.json").is_file():
            return directory
    if (weights := find_published(name)) is not None:
        if published:
            return weights
        raise UserError(
            f"{name} holds published weights, this needs an encoder of ours: convert them, see "
            "load_published in touchgoal.encoders.published"
        )
    if Path(name).is_dir():
        raise UserError(f"no touch encoder in {name}: {ENCODER_FORMAT.remedy}")
    raise UserError(
        f"there is no touch encoder '{name}': give its folder (touchgoal pull makes one from the Hub), or "
        f"the name of a shipped one: {', '.join(encoder_names())}"
    )


def load_encoder(name_or_path: str | Path, sensor: str | None = None) -> AnyTouchEncoder:
    """Load a touch encoder of any kind, as float32 on the CPU, ready for `embed`.

        encoder = load_encoder("gelsight_mini")
        embeddings = encoder.embed(images)  # uint8 (n, 240, 320, 3); the first one untouched

    UserError: no such encoder, a damaged one, or one made for another sensor or version of the
    preprocessor.

    Args:
        name_or_path: See `find_encoder`; `published.load_published` has the options of published ones.
        sensor: Name of the sensor that the encoder must be for; None for any.
    """
    path = find_encoder(name_or_path)
    if not path.is_dir():
        return load_published(path)
    config = ENCODER_FORMAT.read_config(path, _CONFIGS)
    _check_sensor(config, path, sensor)
    encoder: AnyTouchEncoder
    match config:
        case TouchEncoderConfig():
            encoder = TouchEncoder(config)
        case TouchBackboneConfig():
            encoder = TouchBackbone(config)
        case _:
            encoder = PooledEncoder(config)
    ENCODER_FORMAT.load_weights(encoder, path)
    return encoder


def load_pooled_encoder(name_or_path: str | Path) -> PooledEncoder:
    """Load an encoder of `train-encoder surfaces`; UserError for any other."""
    encoder = load_encoder(name_or_path)
    if not isinstance(encoder, PooledEncoder):
        raise UserError(
            f"{name_or_path} was not trained by `train-encoder surfaces`: give one that was"
        )
    return encoder


def _check_sensor(
    config: TouchEncoderConfig | TouchBackboneConfig | PooledEncoderConfig,
    directory: Path,
    sensor: str | None,
) -> None:
    if sensor is not None and config.sensor not in (None, sensor):
        raise UserError(
            f"the encoder in {directory} is for {config.sensor}, not {sensor}: {ENCODER_FORMAT.remedy}"
        )
    if config.sensor is None:  # Sparsh's, with the preprocessor in the config
        return
    version = config.preprocessor_version if isinstance(config, PooledEncoderConfig) else 1
    current = preprocessor_for(config.sensor, version).id
    if config.preprocessor != current:
        raise UserError(
            f"the encoder in {directory} needs the preprocessor {config.preprocessor}, this version has "
            f"{current}: {ENCODER_FORMAT.remedy}"
        )
