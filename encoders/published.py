"""Published Sparsh encoders as touch encoders: a file, a folder or a Hugging Face id.

The layout is that of `tactile_ssl`: a `.ckpt` of the whole training, or a `.safetensors` of the encoder
alone; inside, timm's names. No pickled code runs, and every key must fit.
"""

import math
import pickle
import re
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor, _utils

from touchgoal.encoders.backbones.sparsh import NORM_EPSILON, SQUARE, UPRIGHT
from touchgoal.encoders.backbones.sparsh_input import SPARSH, SPARSH_PLAIN
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone, TouchBackboneConfig
from touchgoal.encoders.backbones.vit import ViT, ViTConfig
from touchgoal.runtime.errors import UserError

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
    from huggingface_hub import snapshot_download

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


# Prefixes of the averaged ("teacher", "target") encoder, which Sparsh probes: DINO, V-JEPA, I-JEPA, MAE,
# and files with the encoder alone.
_PREFIXES = (
    "teacher_encoder.backbone.",
    "target_encoder.backbone.",
    "target_encoder.",
    "encoder.",
    "",
)
_PATCH, _BANDS, _POSITIONS = "patch_embed.proj.weight", "pos_embed.frequency_bands", "pos_embed"
_HEAD_WIDTH = 64  # of ViTs from tiny to large; shapes do not show the number of heads
_THEIRS = {
    "patch": "patch_embed.proj",
    "registers": "register_tokens",
    "positions": _POSITIONS,
    "qkv": "attn.qkv",
    "out": "attn.proj",
    "scale1": "ls1.gamma",
    "scale2": "ls2.gamma",
    "mlp_in": "mlp.fc1",
    "mlp_out": "mlp.fc2",
}
_SHOWN = 20  # keys in a message


def load_sparsh(path: Path) -> ViT:
    """Load a published Sparsh encoder of any method, for inference, as float32 on the CPU.

    The architecture is read off the weights' shapes; images are 224 x 224 or 320 x 240 px,
    whichever the learned positions fit, else 320 x 240. Other objects pickled in a training's
    `.ckpt` are dropped, their code never runs.

    UserError: not such a file, or tensors that do not fit, which are listed.
    """
    tensors = _encoder_tensors(path, _read(path))
    with torch.device("meta"):
        vit = ViT(_config(path, tensors))
    names = {
        ".".join(_THEIRS.get(part, part) for part in name.split(".")): name
        for name in vit.state_dict()
    }
    expected = {theirs: tuple(vit.state_dict()[ours].shape) for theirs, ours in names.items()}
    if not vit.config.learned_positions:
        bands = vit.config.width // (4 if vit.config.tubelet == 1 else 6)
        expected[_BANDS] = (2 if vit.config.tubelet == 1 else 3, bands)
    _check_fit(path, tensors, expected)
    weights = {ours: tensors[theirs].to(torch.float32, copy=True) for theirs, ours in names.items()}
    vit.load_state_dict(weights, assign=True)
    return vit.eval().requires_grad_(False)


class _LeftOut:
    """Stand-in for any class or function that a checkpoint names."""

    def __new__(cls, *_: Any, **__: Any) -> "_LeftOut":
        return super().__new__(cls)

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __call__(self, *_: Any, **__: Any) -> "_LeftOut":
        return self

    def __setstate__(self, _: Any) -> None:
        pass

    def __setitem__(self, _: Any, __: Any) -> None:
        pass

    def append(self, _: Any) -> None:
        pass

    extend = add = append


class _TensorUnpickler(pickle.Unpickler):
    """Unpickler of tensors and containers; torch's own refuses files with anything else."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # All that a checkpoint may call; new wrappers each time, because a pickle can set attributes.
        self._names: dict[tuple[str, str], Callable[..., Any]] = {
            ("collections", "OrderedDict"): OrderedDict,
            ("torch", "Size"): torch.Size,
            ("torch._utils", "_rebuild_tensor_v2"): lambda *a: _utils._rebuild_tensor_v2(*a),
            ("torch._utils", "_rebuild_parameter"): lambda *a: _utils._rebuild_parameter(*a),
        }

    def find_class(self, module_name: str, global_name: str) -> Any:
        return self._names.get((module_name, global_name), _LeftOut)


def _read(path: Path) -> Mapping[str, Any]:
    if not path.is_file():
        raise UserError(f"no such file: {path}")
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        with zipfile.ZipFile(path) as archive:
            scripted = any(name.endswith("constants.pkl") for name in archive.namelist())
        if scripted:
            raise UserError(f"{path} is a program of TorchScript, not weights")
        pickles: Any = SimpleNamespace(__name__="pickles", Unpickler=_TensorUnpickler)
        found = torch.load(path, "cpu", pickle_module=pickles, weights_only=False, mmap=True)
    except UserError:
        raise
    except Exception as error:  # torch.load raises whatever its parts raise
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{path} is damaged or no checkpoint ({reason})") from error
    if isinstance(found, Mapping) and isinstance(found.get("model"), Mapping):
        found = found["model"]
    if not isinstance(found, Mapping):
        raise UserError(f"{path} holds no weights: it is a {type(found).__name__}")
    return found


def _encoder_tensors(path: Path, found: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the encoder's tensors by timm's names."""
    tensors = {str(name): value for name, value in found.items() if isinstance(value, Tensor)}
    for prefix in _PREFIXES:
        if prefix + _PATCH in tensors:
            start = len(prefix)
            return {name[start:]: w for name, w in tensors.items() if name.startswith(prefix)}
    raise UserError(
        f"{path} is no Sparsh encoder: no {_PATCH} in it, but {_listed([str(k) for k in found])}"
    )


def _config(path: Path, tensors: Mapping[str, Tensor]) -> ViTConfig:
    """Return the config that the shapes imply; `_check_fit` finds what is wrong with them."""
    projection = tensors[_PATCH]
    if projection.ndim not in (4, 5) or projection.shape[0] % _HEAD_WIDTH:
        raise UserError(
            f"{path} is no Sparsh encoder: {_PATCH} has the shape {tuple(projection.shape)}"
        )
    width, channels, patch_size = projection.shape[0], projection.shape[1], projection.shape[-1]
    tubelet = projection.shape[2] if projection.ndim == 5 else 1
    blocks = [int(match[1]) for name in tensors if (match := re.match(r"blocks\.(\d+)\.", name))]
    hidden = tensors.get("blocks.0.mlp.fc1.bias")
    registers = tensors.get("register_tokens")
    size, times = UPRIGHT, 2
    if _POSITIONS in tensors:
        size, times = _grid_of(path, tensors[_POSITIONS], patch_size, tubelet)
    return ViTConfig(
        image_size=size,
        patch_size=patch_size,
        channels=channels,
        width=width,
        depth=max(blocks, default=-1) + 1,
        heads=width // _HEAD_WIDTH,
        mlp_ratio=4.0 if hidden is None else len(hidden) / width,
        registers=0 if registers is None else registers.shape[1],
        layer_scale=1.0 if "blocks.0.ls1.gamma" in tensors else None,
        tubelet=tubelet,
        frames=1 if tubelet == 1 else times * tubelet,
        learned_positions=_POSITIONS in tensors,
        norm_epsilon=NORM_EPSILON,
    )


def _grid_of(
    path: Path, positions: Tensor, patch_size: int, tubelet: int
) -> tuple[tuple[int, int], int]:
    """Return the image size that the number of positions fits, and the number of tubelets."""
    count = positions.shape[-2] if positions.ndim > 1 else 0
    for height, width in (SQUARE, UPRIGHT):
        times, left = divmod(count, math.ceil(height / patch_size) * math.ceil(width / patch_size))
        if left == 0 and times >= 1 and (times == 1 or tubelet > 1):
            return (height, width), times
    raise UserError(
        f"{path} has {tuple(positions.shape)} positions, which fit neither images of {SQUARE} nor of "
        f"{UPRIGHT}: give an encoder for one of these sizes"
    )


def _check_fit(
    path: Path, tensors: Mapping[str, Tensor], expected: Mapping[str, tuple[int, ...]]
) -> None:
    found = {name: tuple(weight.shape) for name, weight in tensors.items()}
    wrong = [f"{name} is missing" for name in expected if name not in found]
    wrong += [f"{name} is unknown" for name in found if name not in expected]
    wrong += [
        f"{name} is {found[name]}, not {shape}"
        for name, shape in expected.items()
        if name in found and found[name] != shape
    ]
    if not wrong and _BANDS in expected:
        bands = expected[_BANDS][1]
        ours = 10000.0 ** -(torch.arange(bands) / bands)
        if not torch.allclose(tensors[_BANDS].float(), ours, rtol=1e-4, atol=0):
            wrong = [f"{_BANDS} are not 10000^(-k/{bands})"]
    if wrong:
        raise UserError(f"{path} is no Sparsh encoder that this reads: {_listed(wrong)}")


def _listed(lines: list[str]) -> str:
    more = f" and {len(lines) - _SHOWN} more" if len(lines) > _SHOWN else ""
    return ", ".join(lines[:_SHOWN]) + more
