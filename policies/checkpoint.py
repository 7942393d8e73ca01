"""Policies on disk, checked against the rate that they act at."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from touchgoal.control.errors import UserError
from touchgoal.encoders.training.weights import WeightsFormat
from touchgoal.policies.heads.diffusion import DiffusionConfig, RegressionConfig
from touchgoal.policies.heads.samplers import SamplerConfig
from touchgoal.policies.heads.unet import UNetConfig
from touchgoal.policies.perception.end_to_end import EndToEndConfig
from touchgoal.policies.policy import Policy, PolicyConfig

TOUCH, ESTIMATOR = "touch", "senses"  # folders beside the weights: of the touch encoder, of senses
POLICY = WeightsFormat("policy", "policy", "train one with: touchgoal train-policy")


def save(policy: Policy, directory: Path, provenance: dict[str, Any]) -> None:
    """Writes a policy; an older one in the directory is replaced.

    Weights are stored as float16, scales as float32: rounding a joint position to float16 would
    move the hand by a millimetre.

    Args:
        policy: what to keep.
        directory: made if needed.
        provenance: JSON-able: data, command, seed, metrics of the training.
    """
    weights = {name: tensor.detach().cpu() for name, tensor in policy.state_dict().items()}
    for name, _ in policy.named_parameters():
        weights[name] = weights[name].half()
    POLICY.save(directory, weights, asdict(policy.config), provenance)


def load(directory: Path, control_hz: int | None = None) -> Policy:
    """Reads a policy for acting, as float32 on the CPU.

    Args:
        directory: what `save` wrote.
        control_hz: ticks per second it will act at, if that matters here.

    Raises:
        UserError: nothing there, damaged, or made for another rate.
    """
    config = POLICY.read_config(directory, _config)
    if control_hz is not None and control_hz != config.control_hz:
        raise UserError(
            f"the policy in {directory} acts at {config.control_hz} Hz, not {control_hz}: run it "
            f"at its own rate, or {POLICY.remedy}"
        )
    policy = Policy(config)
    POLICY.load_weights(policy, directory)
    return policy


def _config(fields: dict[str, Any]) -> PolicyConfig:
    head = fields.pop("head")
    if end_to_end := fields.pop("end_to_end", None):
        fields["end_to_end"] = EndToEndConfig(**end_to_end | {"size": tuple(end_to_end["size"])})
    fields["proprioception"] = tuple(fields["proprioception"])
    return PolicyConfig(**fields, head=_read_head(head))


def _read_head(fields: dict[str, Any]) -> DiffusionConfig | RegressionConfig:
    if "unet" not in fields:
        return RegressionConfig(**fields)
    unet = fields["unet"] | {"channels": tuple(fields["unet"]["channels"])}
    return DiffusionConfig(UNetConfig(**unet), SamplerConfig(**fields["sampler"]))
