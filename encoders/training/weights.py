"""Weights on disk: a safetensors file, and a JSON file with their config and provenance.

Loading is strict: wrong weights give numbers that look like any others.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import GenericAlias
from typing import Any, TypeVar

import torch
from pydantic import ConfigDict, TypeAdapter, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from touchgoal.runtime.atomic_write import atomic_write
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import first_problem
from touchgoal.runtime.provenance import portable

FORMAT = 1
_EXACT = ConfigDict(extra="forbid", allow_inf_nan=False)
Config = TypeVar("Config")


@dataclass(frozen=True)
class WeightsFormat:
    """File format of one kind of weights, each in its own folder."""

    stem: str  # stem of both file names
    label: str  # name in messages
    remedy: str  # what to do if there are none

    def weights_path(self, directory: Path) -> Path:
        """Return the path of the weights."""
        return directory / f"{self.stem}.safetensors"

    def save(
        self,
        directory: Path,
        weights: dict[str, Tensor],
        config: dict[str, Any],
        provenance: dict[str, Any],
    ) -> None:
        """Write both files, the provenance without folders of this machine; older files are replaced."""
        description = {"format": FORMAT, "config": config, "provenance": portable(provenance)}
        with (
            atomic_write(self._json_path(directory)) as json_file,
            atomic_write(self.weights_path(directory)) as weights_file,
        ):
            save_file({name: w.contiguous() for name, w in weights.items()}, weights_file)
            json_file.write_text(json.dumps(description, indent=2) + "\n")

    def save_half(
        self, module: nn.Module, directory: Path, config: Any, provenance: dict[str, Any]
    ) -> None:
        """Write a module with its config, a dataclass: parameters as float16, buffers as float32."""
        weights = {name: tensor.detach().cpu() for name, tensor in module.state_dict().items()}
        weights |= {name: weights[name].half() for name, _ in module.named_parameters()}
        self.save(directory, weights, asdict(config), provenance)

    def read_json(self, directory: Path) -> dict[str, Any]:
        """Return the JSON; UserError if it is missing, damaged or of another format."""
        path = self._json_path(directory)
        if not path.is_file():
            raise UserError(f"no {self.label} in {directory}: {self.remedy}")
        try:
            description = json.loads(path.read_text())
            version = description["format"]
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise UserError(f"{path} is damaged: {self.remedy}") from error
        if version != FORMAT:
            raise UserError(
                f"{path} has format {version}, this touchgoal reads {FORMAT}: {self.remedy}"
            )
        return description

    def provenance(self, directory: Path) -> dict[str, Any]:
        """Return the provenance of the training; UserError as for `read_json`."""
        return self.read_json(directory)["provenance"]

    def read_config(
        self, directory: Path, kinds: type[Config] | Mapping[str, type[Config]]
    ) -> Config:
        """Return the config, of a dataclass or of that which its `kind` names.

        UserError: the JSON lacks a field, or has another one.
        """
        try:
            fields = dict(self.read_json(directory)["config"])
            kind = kinds if isinstance(kinds, type) else kinds[fields.pop("kind")]
            one: Any = GenericAlias(tuple, (kind,))  # a dataclass alone takes no config
            return TypeAdapter(one, config=_EXACT).validate_python([fields])[0]
        except (KeyError, TypeError, ValidationError) as error:
            wrong = first_problem(error) if isinstance(error, ValidationError) else str(error)
            raise UserError(
                f"{self._json_path(directory)} is damaged ({wrong.removeprefix('0.')}): {self.remedy}"
            ) from error

    def load_weights(self, module: nn.Module, directory: Path) -> None:
        """Load the weights, as float32, for inference; UserError if they do not fit."""
        path = self.weights_path(directory)
        if not path.is_file():
            raise UserError(f"{path} is missing: {self.remedy}")
        try:
            weights = load_file(path)
        except (SafetensorError, OSError) as error:
            raise UserError(f"{path} is damaged: {self.remedy}") from error
        expected = {name: tuple(weight.shape) for name, weight in module.state_dict().items()}
        found = {name: tuple(weight.shape) for name, weight in weights.items()}
        wrong = [name for name in expected | found if expected.get(name) != found.get(name)]
        if wrong:
            name = wrong[0]
            raise UserError(
                f"{path} does not fit its {self.stem}.json: {name} is {found.get(name)}, not "
                f"{expected.get(name)} ({len(wrong)} tensors differ): {self.remedy}"
            )
        module.load_state_dict({name: weight.to(torch.float32) for name, weight in weights.items()})
        module.eval().requires_grad_(False)

    def _json_path(self, directory: Path) -> Path:
        return directory / f"{self.stem}.json"
