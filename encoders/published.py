"""Published Sparsh encoders as touch encoders: a file, a folder or a Hugging Face id."""

import re
from pathlib import Path

from touchgoal.encoders.backbones.sparsh_input import SPARSH, SPARSH_PLAIN
from touchgoal.encoders.backbones.sparsh_weights import load_sparsh
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone, TouchBackboneConfig
from touchgoal.runtime.errors import UserError, install_extra

_FILES = (".safetensors", ".ckpt")  # the former holds the encoder alone
_PATTERN = "*_vit*"  # e.g. dino_vitbase.safetensors
_HUB_ID = re.compile(r"[\w.-]+/sparsh[\w.-]*", re.IGNORECASE)  # e.g. facebook/sparsh-dino-base
STRIDES = {"pair": 5, "clip": 2}
"""Frames between those of two stacked frames or a clip, as trained with sensors at 60 Hz."""


def find_published(name: str | Path) -> Path | None:
    """Return the file of published weights, fetched if needed; None if `name` is something else.

    `name` is a file, a folder or a Hugging Face id. UserError: several files, or an id that
    cannot be fetched.
    """
    path = Path(name)
    if path.suffix in _FILES:
        return path
    if path.is_dir():
        return _only(path) if _weights_in(path) else None
    return _only(_fetch(str(name))) if _HUB_ID.fullmatch(str(name)) else None


def load_published(
    name: str | Path, stride: int | None = None, subtract: bool = True
) -> TouchBackbone:
    """Load a published encoder with its own preprocessing, for inference, on the CPU.

    For `train-policy --encoder`, save it as a folder of ours first, with the stride that fits a control
    tick (two ticks of 20 Hz are 0.1 s, five frames of 60 Hz 0.083 s):

        save(load_published("facebook/sparsh-dino-base", stride=2), Path("sparsh-dino"), {}, half=False)

    UserError: no such weights, or tensors that do not fit, which are listed.

    Args:
        name: A file of weights, a folder with one, or a Hugging Face id.
        stride: Frames between those that an embedding uses. Default: 5 for two stacked frames and 2
            for clips, as trained, with sensors at 60 Hz.
        subtract: Subtract the untouched sensor, as Sparsh does for the DIGIT and the GelSight Mini and
            not for the GelSight of 2017.
    """
    path = find_published(name)
    if path is None:
        raise UserError(f"no Sparsh encoder in {name}: give a file of weights")
    vit = load_sparsh(path)
    default = STRIDES["pair" if vit.config.tubelet == 1 else "clip"]
    config = TouchBackboneConfig(
        vit.config,
        sensor=None,
        preprocessor=SPARSH if subtract else SPARSH_PLAIN,
        stride=default if stride is None else stride,
    )
    return TouchBackbone(config, vit).eval().requires_grad_(False)


def _weights_in(folder: Path) -> list[Path]:
    """Return the folder's `.safetensors` weights, or its `.ckpt` ones if there are none."""
    kinds = (sorted(folder.glob(_PATTERN + suffix)) for suffix in _FILES)
    return next((files for files in kinds if files), [])


def _only(folder: Path) -> Path:
    files = _weights_in(folder)
    if len(files) != 1:
        found = ", ".join(file.name for file in files) or "none"
        raise UserError(f"{folder} must hold one Sparsh encoder, it holds {found}: give the file")
    return files[0]


def _fetch(repository: str) -> Path:
    """Return the folder in Hugging Face's cache with the weights of a repository."""
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise UserError(f"encoders of Hugging Face need: {install_extra('towers')}") from error
    folder = Path()
    for suffix in _FILES:
        try:
            folder = Path(snapshot_download(repository, allow_patterns=_PATTERN + suffix))
        except Exception as error:  # the client raises whatever its parts raise
            raise UserError(
                f"{repository} is not in Hugging Face's cache and cannot be fetched "
                f"({str(error).splitlines()[0]}): give a file of weights, or first run: "
                f"hf download {repository}"
            ) from error
        if _weights_in(folder):
            break
    return folder
