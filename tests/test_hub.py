"""Encoders and policies by way of a model hub: huggingface_hub's own client, over the wire."""

import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hub_server import TOKEN, HubServer
from huggingface_hub import HfApi, constants

from touchgoal.encoders.hub.repository import pulled, push
from touchgoal.encoders.pretrained import find_encoder, load_encoder
from touchgoal.launch.pull import load_pulled
from touchgoal.policies.checkpoint import SHIPPED_POLICIES, find_policy
from touchgoal.runtime.errors import UserError

ENCODER = find_encoder("gelsight_mini")
POLICY = SHIPPED_POLICIES["pick-place"]


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[HubServer]:
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)  # a protocol of the real hub's own
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)  # conftest.py's, for all other tests
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", "/nonexistent")
    with HubServer().running() as server:
        yield server


def api(hub: HubServer, token: str | None = TOKEN) -> HfApi:
    return HfApi(hub.url, token=token)


def files(folder: Path) -> dict[str, Any]:
    """Content of each file, that of JSON read."""
    read = {".json": lambda path: json.loads(path.read_bytes())}
    there = [path for path in folder.rglob("*") if path.is_file()]
    return {p.relative_to(folder).as_posix(): read.get(p.suffix, Path.read_bytes)(p) for p in there}


def refusal(hub: HubServer, tmp_path: Path, name: str = "lab/model", token: str = TOKEN) -> str:
    with (
        pytest.raises(UserError) as refused,
        pulled(name, tmp_path, api(hub, token)) as (folder, k),
    ):
        load_pulled(folder, k, name)
    assert "\n" not in str(refused.value) and list(tmp_path.iterdir()) == []
    return str(refused.value)


def test_the_commands_push_and_pull_an_encoder(hub: HubServer, tmp_path: Path) -> None:
    """As a person types them; a folder pulled by name is found by that name."""
    environment = {**os.environ, "HF_ENDPOINT": hub.url, "HF_TOKEN": TOKEN}
    environment |= {"HF_HUB_DISABLE_XET": "1", "HF_HUB_OFFLINE": "0", "HF_HOME": str(tmp_path)}
    for arguments in (["push", str(ENCODER), "lab/surfaces"], ["pull", "lab/surfaces"]):
        command = [sys.executable, "-m", "touchgoal.launch", *arguments]
        done = subprocess.run(
            command, env=environment, cwd=tmp_path, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
    there = hub.repositories["lab/surfaces"]
    assert {"config.json", "model.safetensors", "value.safetensors", "README.md"} <= set(there)
    card = there["README.md"].decode()
    assert "library_name: touchgoal" in card and "train-encoder words" in card
    found = files(tmp_path / "lab" / "surfaces")
    assert found.pop("README.md") == card.encode() and found == files(ENCODER)
    load_encoder(tmp_path / "lab/surfaces")


def test_a_policy_keeps_its_parts_and_a_later_push_its_own(hub: HubServer, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(POLICY, run / "policy")
    (run / "policy" / "README.md").write_text("my own card")
    (run / "policy" / "notes.txt").write_text("not data")
    push(run, "lab/picker", private=True, api=api(hub))
    assert hub.private == {"lab/picker"}
    assert hub.repositories["lab/picker"]["README.md"] == b"my own card"
    with pulled("lab/picker", tmp_path, api(hub)) as (folder, kind):
        load_pulled(folder, kind, "lab/picker")
        assert kind == "policy" and find_policy(folder) == folder
        assert files(folder) == {**files(POLICY), "README.md": b"my own card"}
    (run / "policy" / "recipe.json").unlink()
    push(run, "lab/picker", private=True, api=api(hub))
    assert "recipe.json" not in hub.repositories["lab/picker"]
    assert ".gitattributes" in hub.repositories["lab/picker"]  # none of our files


def test_refusals_in_a_line(
    hub: HubServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("HF_TOKEN", raising=False)
    with pytest.raises(UserError, match="there is no token for http://127.* hf auth login"):
        push(ENCODER, "lab/model", False, api(hub, None))
    with pytest.raises(UserError, match="refuses access to lab/model: use a token that may write"):
        push(ENCODER, "lab/model", False, api(hub, "hf_wrong"))
    with pytest.raises(UserError, match="'lab/a--b' is no name of a repository"):
        push(ENCODER, "lab/a--b", False, api(hub))
    assert "has no model lab/model that you may read" in refusal(hub, tmp_path)
    push(ENCODER, "lab/hidden", True, api(hub))
    assert "private" in refusal(hub, tmp_path, "lab/hidden", "hf_wrong")
    with (
        pytest.raises(UserError, match="^cannot reach http://127.0.0.1:9 .*: check the network"),
        pulled("lab/model", tmp_path, HfApi("http://127.0.0.1:9")),
    ):
        pass


def test_others_files_are_refused_and_no_code_is_fetched(hub: HubServer, tmp_path: Path) -> None:
    push(ENCODER, "lab/model", False, api(hub))
    sound = dict(hub.repositories["lab/model"])
    np.savez(pickled := io.BytesIO(), about=np.array([{}], object))
    other = json.dumps(json.loads(sound["config.json"]) | {"model_type": "bert"}).encode()
    for changes, message in (
        ({"config.json": other}, "holds no encoder or policy that touchgoal push made"),
        ({"config.json": b"{"}, "lab/model: config.json is damaged or no json"),
        ({"model.safetensors": b"\x80\x04pickle"}, "is damaged or no safetensors"),
        ({"goal.npz": pickled.getvalue()}, "goal.npz is damaged or no npz"),
        ({"goal.npz": b"PK"}, "goal.npz is damaged or no npz"),
        ({"model.safetensors": sound["value.safetensors"]}, "does not fit its encoder.json"),
    ):
        hub.repositories["lab/model"] = sound | changes
        assert message in refusal(hub, tmp_path), changes
    code = {"modeling.py": b"1/0", "a.pt": b"", "../evil.json": b"{}", "a/b/c/d.json": b"{}"}
    hub.repositories["lab/model"] = sound | code
    with pulled("lab/model", tmp_path, api(hub)) as (folder, _):
        assert set(files(folder)) == {*files(ENCODER), "README.md"}
