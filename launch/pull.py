"""Download an encoder or a policy that `push` uploaded to the Hugging Face Hub, and check it.

Afterwards `--encoder owner/name` or `--policy owner/name` finds it, in the same working directory.
"""

from pathlib import Path
from typing import Annotated

import tyro

from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Repository, checked_dataclass


@checked_dataclass
class Config:
    """Options of pull."""

    repository: Annotated[Repository, tyro.conf.Positional]
    """Repository on the Hub, as owner/name."""
    out: Path | None = None
    """Folder for the model, which must not exist yet; default: owner/name."""


def main(config: Config) -> None:
    """Download into a temporary folder, load once, and move into place."""
    from huggingface_hub import HfApi

    from touchgoal.encoders.hub.repository import pulled

    out = config.out or Path(config.repository)
    if out.exists():
        raise UserError(f"{out} exists: remove it, or name another --out")
    beside = next(parent for parent in out.absolute().parents if parent.exists())
    with pulled(config.repository, beside, HfApi()) as (folder, kind):
        load_pulled(folder, kind, config.repository)
        out.parent.mkdir(parents=True, exist_ok=True)
        folder.rename(out)
    print(f"{kind}: {out}")


def load_pulled(folder: Path, kind: str, repository: str) -> None:
    """Load a pulled model once; UserError unless its weights fit its config."""
    from touchgoal.encoders.pretrained import load_encoder
    from touchgoal.policies.checkpoint import load_policy

    load = {"encoder": load_encoder, "policy": load_policy}[kind]
    try:
        load(folder)
    except UserError as error:
        raise UserError(str(error).replace(str(folder), repository)) from error
    except Exception as error:  # a config of anyone's: whatever its values lead to
        raise UserError(f"{repository} is no {kind} of touchgoal: {error}") from error
