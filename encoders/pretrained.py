"""Encoders on disk: weights as safetensors, and a JSON that says what they are.

Loading is strict. A wrong encoder gives numbers that look like any others, so whatever does not fit
(sensor, preprocessor version, towers, a tensor's name or shape) is an error.
"""

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from touchgoal.control.errors import UserError
from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.encoders.touch_encoder import TouchEncoder, TouchEncoderConfig
from touchgoal.encoders.towers import same_towers
from touchgoal.encoders.trunk import TouchTrunk, TouchTrunkConfig
from touchgoal.encoders.vit import ViTConfig

FORMAT = 1
SHIPPED = Path(__file__).parent / "weights" / "gelsight_mini_offline"
Encoder = TypeVar("Encoder", TouchEncoder, TouchTrunk)
Config = TypeVar("Config", TouchEncoderConfig, TouchTrunkConfig)
_JSON, _WEIGHTS = "encoder.json", "encoder.safetensors"
_TRAIN = "train one with: touchgoal train-encoder"


def save(
    encoder: TouchEncoder | TouchTrunk,
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
    directory.mkdir(parents=True, exist_ok=True)
    dtype = torch.float16 if half else torch.float32
    weights = {
        name: weight.detach().cpu().to(dtype).contiguous()
        for name, weight in encoder.state_dict().items()
    }
    description = {"format": FORMAT, "config": asdict(encoder.config), "provenance": provenance}
    save_file(weights, directory / f"{_WEIGHTS}.tmp")
    (directory / f"{_JSON}.tmp").write_text(json.dumps(description, indent=2) + "\n")
    for name in (_WEIGHTS, _JSON):
        os.replace(directory / f"{name}.tmp", directory / name)


def load(directory: Path, sensor: str | None = None, towers: str | None = None) -> TouchEncoder:
    """Reads an encoder for inference, as float32 on the CPU.

    Args:
        directory: What `save` wrote, e.g. `SHIPPED`.
        sensor: Name of the sensor it is meant for, if that matters here.
        towers: `Towers.name` it is meant for, if that matters here.

    Raises:
        UserError: Nothing there, damaged, or not made for this sensor, these towers or this
            version of the preprocessor.
    """
    config = _read_config(directory, TouchEncoderConfig)
    if towers is not None and not same_towers(towers, config.towers):
        raise UserError(
            f"the encoder in {directory} was trained with the towers {config.towers}, not {towers}: "
            "load those towers, or train an encoder with these"
        )
    _check_sensor(config, directory, sensor)
    return _filled(TouchEncoder(config), directory)


def load_trunk(directory: Path, sensor: str | None = None) -> TouchTrunk:
    """Reads a self-supervised trunk for inference, as float32 on the CPU; UserError as `load`."""
    config = _read_config(directory, TouchTrunkConfig)
    _check_sensor(config, directory, sensor)
    return _filled(TouchTrunk(config), directory)


def load_any(directory: Path) -> TouchEncoder | TouchTrunk:
    """Reads an encoder of either kind for inference; UserError as `load`."""
    aligned = "towers" in _read_description(directory).get("config", {})
    return load(directory) if aligned else load_trunk(directory)


def weights_path(directory: Path) -> Path:
    """The weights' file in an encoder's folder."""
    return directory / _WEIGHTS


def _check_sensor(
    config: TouchEncoderConfig | TouchTrunkConfig, directory: Path, sensor: str | None
) -> None:
    if sensor is not None and sensor != config.sensor:
        raise UserError(
            f"the encoder in {directory} is for {config.sensor}, not {sensor}: {_TRAIN}"
        )
    current = preprocessor_for(config.sensor).id
    if config.preprocessor != current:
        raise UserError(
            f"the encoder in {directory} needs the preprocessor {config.preprocessor}, this is "
            f"{current}: {_TRAIN}"
        )


def _filled(encoder: Encoder, directory: Path) -> Encoder:
    encoder.load_state_dict(_read_weights(directory / _WEIGHTS, encoder))
    return encoder.eval().requires_grad_(False)


def read_provenance(directory: Path) -> dict[str, Any]:
    """What `save` was told about the training; UserError as for `load`."""
    return _read_description(directory)["provenance"]


def _read_description(directory: Path) -> dict[str, Any]:
    path = directory / _JSON
    if not path.is_file():
        raise UserError(f"no touch encoder in {directory}: {_TRAIN}")
    try:
        description = json.loads(path.read_text())
        version = description["format"]
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is damaged: {_TRAIN}") from error
    if version != FORMAT:
        raise UserError(f"{path} has format {version}, this touchgoal reads {FORMAT}: {_TRAIN}")
    return description


def _read_config(directory: Path, kind: type[Config]) -> Config:
    try:
        fields = dict(_read_description(directory)["config"])
        vit = fields.pop("vit")
        vit["image_size"] = tuple(vit["image_size"])
        return kind(vit=ViTConfig(**vit), **fields)
    except (KeyError, TypeError) as error:
        raise UserError(f"{directory / _JSON} is damaged ({error}): {_TRAIN}") from error


def _read_weights(path: Path, encoder: TouchEncoder | TouchTrunk) -> dict[str, torch.Tensor]:
    if not path.is_file():
        raise UserError(f"{path} is missing: {_TRAIN}")
    try:
        weights = load_file(path)
    except (SafetensorError, OSError) as error:
        raise UserError(f"{path} is damaged: {_TRAIN}") from error
    expected = {name: tuple(weight.shape) for name, weight in encoder.state_dict().items()}
    found = {name: tuple(weight.shape) for name, weight in weights.items()}
    wrong = [name for name in expected | found if expected.get(name) != found.get(name)]
    if wrong:
        name = wrong[0]
        raise UserError(
            f"{path} does not fit its {_JSON}: {name} is {found.get(name)}, not "
            f"{expected.get(name)} ({len(wrong)} tensors differ): {_TRAIN}"
        )
    return {name: weight.float() for name, weight in weights.items()}
