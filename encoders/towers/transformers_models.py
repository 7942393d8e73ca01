"""Loading of transformers' models: by Hugging Face id, or from a folder without network access."""

import os
from typing import Any

import torch

from touchgoal.runtime.errors import UserError, wheel_folder


def load_model(source: str, class_name: str, model_type: str, device: str) -> Any:
    """Load a model of a class of transformers by Hugging Face id or folder, frozen, in float32.

    UserError: transformers is missing, there is no such model, it is another one, or its weights
    are incomplete.
    """
    wheel_folder("transformers")
    import transformers

    local = os.path.isdir(source)
    try:
        config = transformers.PretrainedConfig.get_config_dict(source, local_files_only=local)[0]
        if not config:  # what transformers returns for a directory without config.json
            raise FileNotFoundError(source)
        if (kind := config.get("model_type")) != model_type:
            raise UserError(f"{source} is a '{kind}', no {model_type}: give a {model_type}")
        model, report = getattr(transformers, class_name).from_pretrained(
            source, local_files_only=local, dtype=torch.float32, output_loading_info=True
        )
    except OSError as error:
        raise _not_found(source, model_type) from error
    if report["missing_keys"]:  # transformers would leave those random
        raise UserError(f"the weights in {source} are incomplete: fetch them again")
    return model.eval().requires_grad_(False).to(device)


def load_part(source: str, part: Any) -> Any:
    """Load a tokenizer or an image processor: `part` is a class of transformers.

    UserError: it is not there.
    """
    try:
        return part.from_pretrained(source, local_files_only=os.path.isdir(source))
    except (OSError, ValueError) as error:  # ValueError where no tokenizer can be told
        raise _not_found(source, part.__name__) from error


def _not_found(source: str, what: str) -> UserError:
    hint = (
        "it must hold config.json, model.safetensors, and the files of tokenizer and image processor"
        if os.path.isdir(source)
        else "no such directory, not in Hugging Face's cache and not to be fetched from here; "
        f"give a local directory, or first run: hf download {source}"
    )
    return UserError(f"cannot load {source} ({what}): {hint}")
