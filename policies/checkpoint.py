"""Policies on disk: weights as safetensors, and a JSON that says what they are.

Loading is strict, as it is for encoders: a policy that gets other embeddings or another rate than
in training moves the arm all the same.
"""

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from touchgoal.control.errors import UserError
from touchgoal.policies.diffusion import DiffusionConfig, RegressionConfig
from touchgoal.policies.eyes import EyeConfig
from touchgoal.policies.policy import Policy, PolicyConfig
from touchgoal.policies.samplers import SamplerConfig
from touchgoal.policies.unet import UNetConfig

FORMAT = 1
TOUCH = "touch"  # folder of the touch encoder beside the weights
_JSON, _WEIGHTS = "policy.json", "policy.safetensors"
_TRAIN = "train one with: touchgoal train-policy"


def save(policy: Policy, directory: Path, provenance: dict[str, Any]) -> None:
    """Writes a policy; an older one in the directory is replaced.

    Weights are stored as float16, scales as float32: rounding a joint position to float16 would
    move the hand by a millimetre.

    Args:
        policy: what to keep.
        directory: made if needed.
        provenance: JSON-able: data, command, seed, metrics of the training.
    """
    directory.mkdir(parents=True, exist_ok=True)
    weights = {name: tensor.detach().cpu() for name, tensor in policy.state_dict().items()}
    for name, _ in policy.named_parameters():
        weights[name] = weights[name].half()
    contiguous = {name: tensor.contiguous() for name, tensor in weights.items()}
    description = {"format": FORMAT, "config": asdict(policy.config), "provenance": provenance}
    save_file(contiguous, directory / f"{_WEIGHTS}.tmp")
    (directory / f"{_JSON}.tmp").write_text(json.dumps(description, indent=2) + "\n")
    for name in (_WEIGHTS, _JSON):
        os.replace(directory / f"{name}.tmp", directory / name)


def load(directory: Path, touch: str | None = None, control_hz: int | None = None) -> Policy:
    """Reads a policy for acting, as float32 on the CPU.

    Args:
        directory: what `save` wrote.
        touch: `PolicyConfig.touch` it will be given, if that matters here.
        control_hz: ticks per second it will act at, if that matters here.

    Raises:
        UserError: nothing there, damaged, or made for other embeddings or another rate.
    """
    config = _read_config(directory)
    if touch is not None and touch != config.touch:
        raise UserError(
            f"the policy in {directory} feels through {config.touch!r}, not {touch!r}: load that "
            f"encoder, or {_TRAIN}"
        )
    if control_hz is not None and control_hz != config.control_hz:
        raise UserError(
            f"the policy in {directory} acts at {config.control_hz} Hz, not {control_hz}: run it "
            f"at its own rate, or {_TRAIN}"
        )
    policy = Policy(config)
    policy.load_state_dict(_read_weights(directory / _WEIGHTS, policy))
    return policy.eval().requires_grad_(False)


def read_provenance(directory: Path) -> dict[str, Any]:
    """What `save` was told about the training; UserError as for `load`."""
    return _read_description(directory)["provenance"]


def _read_description(directory: Path) -> dict[str, Any]:
    path = directory / _JSON
    if not path.is_file():
        raise UserError(f"no policy in {directory}: {_TRAIN}")
    try:
        description = json.loads(path.read_text())
        version = description["format"]
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is damaged: {_TRAIN}") from error
    if version != FORMAT:
        raise UserError(f"{path} has format {version}, this touchgoal reads {FORMAT}: {_TRAIN}")
    return description


def _read_config(directory: Path) -> PolicyConfig:
    try:
        fields = dict(_read_description(directory)["config"])
        head = fields.pop("head")
        if eye := fields.pop("eye", None):
            fields["eye"] = EyeConfig(**eye | {k: tuple(eye[k]) for k in ("keys", "size")})
        fields["proprioception"] = tuple(fields["proprioception"])
        return PolicyConfig(**fields, head=_read_head(head))
    except (KeyError, TypeError) as error:
        raise UserError(f"{directory / _JSON} is damaged ({error}): {_TRAIN}") from error


def _read_head(fields: dict[str, Any]) -> DiffusionConfig | RegressionConfig:
    if "unet" not in fields:
        return RegressionConfig(**fields)
    unet = fields["unet"] | {"channels": tuple(fields["unet"]["channels"])}
    return DiffusionConfig(UNetConfig(**unet), SamplerConfig(**fields["sampler"]))


def _read_weights(path: Path, policy: Policy) -> dict[str, torch.Tensor]:
    if not path.is_file():
        raise UserError(f"{path} is missing: {_TRAIN}")
    try:
        weights = load_file(path)
    except (SafetensorError, OSError) as error:
        raise UserError(f"{path} is damaged: {_TRAIN}") from error
    expected = {name: tuple(weight.shape) for name, weight in policy.state_dict().items()}
    found = {name: tuple(weight.shape) for name, weight in weights.items()}
    wrong = [name for name in expected | found if expected.get(name) != found.get(name)]
    if wrong:
        name = wrong[0]
        raise UserError(
            f"{path} does not fit its {_JSON}: {name} is {found.get(name)}, not "
            f"{expected.get(name)} ({len(wrong)} tensors differ): {_TRAIN}"
        )
    return {name: weight.float() for name, weight in weights.items()}
