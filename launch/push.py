"""Upload an encoder or a policy to the Hugging Face Hub, with a model card from its provenance."""

from pathlib import Path
from typing import Annotated

import tyro

from touchgoal.runtime.option_types import Repository, checked_dataclass


@checked_dataclass
class Config:
    """Options of push."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of the encoder or policy, or the --out of its training."""
    repository: Annotated[Repository, tyro.conf.Positional]
    """Repository on the Hub, as owner/name; made if needed."""
    private: bool = False
    """Make a new repository private."""


def main(config: Config) -> None:
    """Upload and print the address."""
    from huggingface_hub import HfApi

    from touchgoal.encoders.hub.repository import push

    print(f"pushed: {push(config.folder, config.repository, config.private, HfApi())}")
