"""The benchmark of encoders' speed: its peer is the same function, and a toy run of the command."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from touchgoal.benchmarks.plain_torch import PlainMae, PlainViT
from touchgoal.encoders.backbones.sparsh import SPARSH_BASE
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone, TouchBackboneConfig
from touchgoal.encoders.backbones.vit import PRESETS, ViT, random_masking, sinusoidal_positions
from touchgoal.encoders.config import MaeConfig
from touchgoal.encoders.pretrained import save
from touchgoal.encoders.ssl.mae import MaskedAutoencoder
from touchgoal.launch.__main__ import main


@pytest.mark.parametrize("method", SPARSH_BASE)
@pytest.mark.parametrize("training", [False, True])  # torch takes another way through its layers
def test_the_peer_is_the_same_function(method: str, training: bool) -> None:
    torch.manual_seed(0)
    size = (40, 32)  # 40 is no multiple of the patch
    config = replace(SPARSH_BASE[method], width=48, heads=4, depth=2, image_size=size)
    vit = ViT(config)
    for name, weight in vit.named_parameters():
        if name.endswith(("scale1", "scale2", "bias")):
            torch.nn.init.normal_(weight)
    plain = PlainViT(vit).train(training)
    clip = (4,) if config.tubelet > 1 else ()
    pictures = torch.rand(2, config.channels, *clip, *size)
    with torch.inference_mode(not training):
        torch.testing.assert_close(plain(pictures), vit(pictures), atol=1e-4, rtol=1e-4)


def test_the_peer_of_the_mae_learns_the_same() -> None:
    torch.manual_seed(0)
    mae = MaskedAutoencoder(MaeConfig(vit="compact"), "gelsight_mini")
    plain = PlainMae(mae, sinusoidal_positions(8, 10, mae.config.decoder_width))
    touch = torch.randn(3, 3, 120, 160)
    ids_keep = random_masking(PRESETS["compact"], 3, 0.5, torch.Generator().manual_seed(0))
    ours, other = mae.loss(touch, ids_keep), plain(touch, ids_keep)
    torch.testing.assert_close(ours, other)
    (gradient,) = torch.autograd.grad(ours, [mae.get_parameter("backbone.vit.blocks.0.qkv.weight")])
    (others,) = torch.autograd.grad(
        other, [plain.get_parameter("vit.blocks.layers.0.self_attn.in_proj_weight")]
    )
    torch.testing.assert_close(gradient, others, atol=1e-7, rtol=1e-3)


def test_the_command_prints_every_encoder_beside_its_peer(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    pair = replace(PRESETS["tiny"], channels=6)
    backbone = TouchBackbone(TouchBackboneConfig.for_sensor(pair, "gelsight_mini", 2))
    save(backbone, tmp_path / "pair", {})
    main(
        ["benchmark", "encoder-speed", "--encoders", str(tmp_path / "pair"), "gelsight_mini_surfaces",
         "--shapes", "mae-tiny", "--batch-size", "2", "--repeats", "1", "--ticks", "1", "--mae-vit", "tiny",
         "--mae-batch-size", "4", "--mae-steps", "2", "--out", str(tmp_path / "run")]
    )  # fmt: skip
    printed = capsys.readouterr().out
    assert "Sparsh mae-tiny, random" in printed and "a training step of the tiny MAE" in printed
    rows = json.loads((tmp_path / "run" / "metrics.json").read_text())["rows"]
    assert [row["precision"] for row in rows] == ["fp32", "bf16", "fp32", "fp32", "bf16"]
    assert all((row["batched_ratio"] is None) == ("surfaces" in row["encoder"]) for row in rows)
