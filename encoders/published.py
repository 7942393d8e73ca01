"""Published Sparsh encoders as touch encoders: a file, a folder or an id of Hugging Face."""

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
"""As trained, of two stacked frames and of clips: frames of a sensor at 60 Hz."""


def is_published(name: str | Path) -> bool:
    """Whether this names weights in Sparsh's layout, there or not, rather than an encoder of ours."""
    path = Path(name)
    if path.is_dir():
        return not (path / "encoder.json").exists() and bool(_found(path))
    return path.suffix in _FILES or (not path.exists() and bool(_HUB_ID.fullmatch(str(name))))


def load_published(
    name: str | Path, stride: int | None = None, subtract: bool = True
) -> TouchBackbone:
    """A published encoder that makes its own input, for inference, on the CPU.

    To use one in `train-policy --encoder`, save it as a folder of ours first, with the stride that a control tick
    asks for (two ticks of 20 Hz are 0.1 s, five frames of 60 Hz 0.083 s):

        save(load_published("facebook/sparsh-dino-base", stride=2), Path("sparsh-dino"), {}, half=False)

    Args:
        name: A file of weights, a folder with one, or an id of Hugging Face.
        stride: Frames from one that an embedding sees to the one before. Default: 5 for two stacked
            frames and 2 for clips, as trained, with sensors at 60 Hz.
        subtract: Take out the untouched sensor, as Sparsh does for the DIGIT and the GelSight Mini and not
            for the GelSight of 2017.

    Raises:
        UserError: None there, not to be fetched, or weights that do not fit, which are listed.
    """
    vit = load_sparsh(_file(name))
    default = STRIDES["pair" if vit.config.tubelet == 1 else "clip"]
    config = TouchBackboneConfig(
        vit.config,
        sensor=None,
        preprocessor=SPARSH if subtract else SPARSH_PLAIN,
        stride=default if stride is None else stride,
    )
    encoder = TouchBackbone(config, vit)
    return encoder.eval().requires_grad_(False)


def _file(name: str | Path) -> Path:
    path = Path(name)
    if path.is_file() or path.suffix in _FILES:
        return path
    return _only(path if path.is_dir() else _fetched(str(name)))


def _found(folder: Path) -> list[Path]:
    """Weights of the shortest kind that there is."""
    kinds = (sorted(folder.glob(_PATTERN + suffix)) for suffix in _FILES)
    return next((files for files in kinds if files), [])


def _only(folder: Path) -> Path:
    files = _found(folder)
    if len(files) != 1:
        named = ", ".join(file.name for file in files) or "none"
        raise UserError(f"{folder} holds not one Sparsh encoder but {named}: give the file")
    return files[0]


def _fetched(repository: str) -> Path:
    """A folder of Hugging Face's cache with the weights of a repository."""
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise UserError(f"encoders of Hugging Face need: {install_extra('towers')}") from error
    folder = Path()
    for suffix in _FILES:  # the next one only if there is none of the former
        try:
            folder = Path(snapshot_download(repository, allow_patterns=_PATTERN + suffix))
        except Exception as error:  # the client raises whatever its parts raise
            raise UserError(
                f"{repository} is neither in Hugging Face's cache nor to be fetched from here "
                f"({str(error).splitlines()[0]}): give a file of weights, or first run: "
                f"hf download {repository}"
            ) from error
        if _found(folder):
            break
    return folder
