"""The benchmark of encoders' speed at toy size."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from touchgoal.encoders.backbones.touch_backbone import TouchBackbone, TouchBackboneConfig
from touchgoal.encoders.backbones.vit import PRESETS
from touchgoal.encoders.pretrained import save
from touchgoal.launch.__main__ import main


def test_the_command_prints_every_encoder_beside_its_peer(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    pair = replace(PRESETS["tiny"], channels=6)
    backbone = TouchBackbone(TouchBackboneConfig.for_sensor(pair, "gelsight_mini", 2))
    save(backbone, tmp_path / "pair", {})
    main(
        ["benchmark", "encoder-speed", "--encoders", str(tmp_path / "pair"), "gelsight_mini_surfaces",
         "--shapes", "mae-tiny", "--batch-size", "2", "--repeats", "1", "--ticks", "1", "--out", str(tmp_path / "run")]
    )  # fmt: skip
    printed = capsys.readouterr().out
    assert "Sparsh mae-tiny, random" in printed
    rows = json.loads((tmp_path / "run" / "metrics.json").read_text())["rows"]
    assert [row["precision"] for row in rows] == ["fp32", "bf16", "fp32", "fp32", "bf16"]
    assert all((row["batched_ratio"] is None) == ("surfaces" in row["encoder"]) for row in rows)
