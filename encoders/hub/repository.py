"""Encoders and policies on the Hugging Face Hub: pushed and pulled as data, never as code.

A repository holds the files of the model's folder. The main pair has the Hub's own names,
`config.json` and `model.safetensors`; `model_type` in the former tells encoder from policy.
"""

import json
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal, get_args
from zipfile import BadZipFile

import numpy as np
from safetensors import SafetensorError, safe_open

from touchgoal.runtime.errors import UserError

if TYPE_CHECKING:
    from huggingface_hub import HfApi

Kind = Literal["encoder", "policy"]
KINDS: tuple[Kind, ...] = get_args(Kind)
CONFIG, WEIGHTS = "config.json", "model.safetensors"
_MODEL_TYPE = "model_type"  # the Hub's key in config.json
_DATA_FILE = re.compile(r"(\w[\w-]*/){0,2}\w[\w-]*\.(json|safetensors|npz)")
"""Paths that are pushed and pulled, beside the card: at most two folders deep."""
_LOG_IN = "log in with: hf auth login (or set HF_TOKEN)"


def find_model(folder: Path) -> tuple[Path, Kind]:
    """Return the folder of an encoder or a policy, also inside a training's --out, and its kind.

    UserError: there is neither.
    """
    for kind in KINDS:
        for path in (folder, folder / kind):
            if (path / f"{kind}.json").is_file():
                return path, kind
    raise UserError(
        f"no encoder or policy in {folder}: give the folder that train-encoder or train-policy wrote"
    )


def push(folder: Path, repository: str, private: bool, api: "HfApi") -> str:
    """Upload an encoder or a policy in one commit and return the commit's address.

    The repository is made if needed, public or private; files of an earlier push that are gone here are deleted there.
    A card that lies in the folder is used in place of a new one.

    UserError: no such folder, no token, no network, or the Hub refuses.
    """
    from huggingface_hub import CommitOperationAdd, CommitOperationDelete, get_token

    folder, kind = find_model(folder)
    if not (api.token or get_token()):
        raise UserError(f"there is no token for {api.endpoint}: {_LOG_IN}")
    files = _files_to_push(folder, kind, repository)
    with _one_line_errors(repository, api):
        api.create_repo(repository, private=private or None, exist_ok=True)
        stale = [name for name in _data_files(repository, api)[1] if name not in files]
        commit = api.create_commit(
            repository,
            [
                *(CommitOperationAdd(name, content) for name, content in files.items()),
                *(CommitOperationDelete(name) for name in stale),
            ],
            commit_message=f"Upload {kind} with touchgoal",
        )
    return str(commit.commit_url)


@contextmanager
def pulled(repository: str, beside: Path, api: "HfApi") -> Iterator[tuple[Path, Kind]]:
    """Download an encoder or a policy; yield its temporary folder, in `beside`, and its kind.

    Only JSON, safetensors, npz and the card are downloaded, and each file is opened to check it. To
    keep the folder, the caller moves it.

    UserError: no network, no such repository, no access, a damaged file, or no model that `push`
    uploaded.
    """
    with TemporaryDirectory(prefix=".pull_", dir=beside) as temporary:
        folder = Path(temporary) / "model"
        with _one_line_errors(repository, api):
            commit, names = _data_files(repository, api)
            if not {CONFIG, WEIGHTS} <= set(names):
                raise _not_ours(repository)
            for name in names:
                api.hf_hub_download(repository, name, revision=commit, local_dir=folder)
        shutil.rmtree(folder / ".cache", ignore_errors=True)  # the client's notes
        for name in names:
            _check_file(folder / name, f"{repository}: {name}")
        yield folder, _rename_as_on_disk(folder, repository)


def _files_to_push(folder: Path, kind: Kind, repository: str) -> dict[str, Path | bytes]:
    """Return the content of each file of the repository: a path on disk, or bytes."""
    names = [p.relative_to(folder).as_posix() for p in sorted(folder.rglob("*")) if p.is_file()]
    files: dict[str, Path | bytes] = {n: folder / n for n in names if _DATA_FILE.fullmatch(n)}
    description = json.loads((folder / f"{kind}.json").read_text())
    files[WEIGHTS] = files.pop(f"{kind}.safetensors")
    del files[f"{kind}.json"]
    files[CONFIG] = _to_json({_MODEL_TYPE: f"touchgoal_{kind}", **description}).encode()
    card = folder / CARD
    files[CARD] = card if card.is_file() else model_card(kind, description, repository).encode()
    return files


def _data_files(repository: str, api: "HfApi") -> tuple[str, list[str]]:
    """Return the newest commit and the paths of the files of ours in it."""
    info = api.model_info(repository)
    names = [sibling.rfilename for sibling in info.siblings or []]
    return str(info.sha), [n for n in names if n == CARD or _DATA_FILE.fullmatch(n)]


def _check_file(path: Path, name: str) -> None:
    """UserError unless the file is what its suffix says; nothing in it is run."""
    try:
        if path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".safetensors":
            with safe_open(path, framework="numpy"):
                pass
        elif path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as stored:
                dict(stored)
    except (ValueError, RecursionError, SafetensorError, OSError, BadZipFile) as error:
        raise UserError(f"{name} is damaged or no {path.suffix[1:]}: {error}") from error


def _rename_as_on_disk(folder: Path, repository: str) -> Kind:
    """Give the main pair the names that `WeightsFormat` reads; return the kind of model."""
    description = json.loads((folder / CONFIG).read_text())
    model_type = description.pop(_MODEL_TYPE, None) if isinstance(description, dict) else None
    kinds: list[Kind] = [kind for kind in KINDS if model_type == f"touchgoal_{kind}"]
    if not kinds:
        raise _not_ours(repository)
    [kind] = kinds
    (folder / CONFIG).unlink()
    (folder / f"{kind}.json").write_text(_to_json(description))
    (folder / WEIGHTS).rename(folder / f"{kind}.safetensors")
    return kind


def _to_json(description: dict[str, Any]) -> str:
    return json.dumps(description, indent=2) + "\n"


def _not_ours(repository: str) -> UserError:
    return UserError(f"{repository} holds no encoder or policy that touchgoal push made")


@contextmanager
def _one_line_errors(repository: str, api: "HfApi") -> Iterator[None]:
    """Turn the client's exceptions into a UserError with what to do."""
    from huggingface_hub import errors

    try:
        yield
    except (UserError, MemoryError):
        raise
    except errors.HFValidationError as error:
        raise UserError(f"{repository!r} is no name of a repository: give owner/name") from error
    except errors.RepositoryNotFoundError as error:  # also for a private one, without a token
        raise UserError(
            f"{api.endpoint} has no model {repository} that you may read: check the name, or if it is "
            f"private {_LOG_IN}"
        ) from error
    except errors.HfHubHTTPError as error:
        status = error.response.status_code
        if status in (401, 403):
            raise UserError(
                f"{api.endpoint} refuses access to {repository}: use a token that may write there; {_LOG_IN}"
            ) from error
        raise UserError(
            f"{api.endpoint} answered {status} for {repository}: try again later"
        ) from error
    except Exception as error:  # the client raises whatever its parts raise
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise UserError(
            f"cannot reach {api.endpoint} ({reason}): check the network, HF_ENDPOINT and HF_HUB_OFFLINE"
        ) from error


CARD = "README.md"
_TITLES = {"encoder": "Touch encoder", "policy": "Policy"}
_PIPELINES = {"encoder": "image-feature-extraction", "policy": "robotics"}  # the Hub's names
_USES = {
    "encoder": "touchgoal reward-curves VIDEO --encoder {repository}",
    "policy": "touchgoal run-policy --task {task} --policy {repository}",
}


def model_card(kind: str, description: dict[str, Any], repository: str) -> str:
    """Return the card of `repository` (owner/name) as Markdown with the Hub's front matter.

    `description` is the JSON beside the weights: format, config and provenance.
    """
    config, provenance = description["config"], description["provenance"]
    use = _USES[kind].format(repository=repository, task=config.get("task"))
    return f"""---
library_name: touchgoal
pipeline_tag: {_PIPELINES[kind]}
tags: [touchgoal, tactile]
---

# {repository.rpartition("/")[2]}

{_TITLES[kind]} for the tactile sensor `{config.get("sensor")}`, trained with touchgoal
{provenance.get("touchgoal", "")}. Weights are safetensors; nothing in this repository is code.

```
touchgoal pull {repository}
{use}
```

## Provenance

```json
{json.dumps(provenance, indent=2)}
```

## Configuration

```json
{json.dumps(config, indent=2)}
```
"""
