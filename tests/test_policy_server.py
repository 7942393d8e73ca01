"""Policies behind a server that speaks openpi's protocol."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest

from touchgoal.control import features as ft
from touchgoal.control.deployment.realtime import RealTimeActor
from touchgoal.control.policy_server.policy import ServedPolicy
from touchgoal.launch.__main__ import main
from touchgoal.runtime.errors import UserError

pytest.importorskip("msgpack")
server = pytest.importorskip("websockets.sync.server")

from touchgoal.control.policy_server.connection import pack, unpack  # noqa: E402

# What openpi_client.msgpack_numpy 0.1.2 packs.
OF_OPENPI = "82a7616374696f6e7384c40b5f5f6e6461727261795f5fc3c40464617461c4080000003f000080bfc4056474797065a33c6634c4057368617065920102a16e83c40d5f5f6e7067656e657269635f5fc3c4046461746103c4056474797065a33c6938"
TO_OPENPI = "82a16184c40b5f5f6e6461727261795f5fc3c40464617461c403000102c4056474797065a37c7531c40573686170659103a670726f6d7074a2676f"
TICK = {ft.STATE: np.zeros(15, np.float32), ft.FRONT: np.zeros((6, 8, 3), np.uint8)}
CHUNK = np.arange(48, dtype=np.float32).reshape(6, 8) * 1e-4


@contextmanager
def serving(infer: Callable[[dict], Any]) -> Iterator[str]:
    """As openpi's server: metadata, then an answer each; an error is a traceback as text."""

    def handle(connection: Any) -> None:
        connection.send(pack({"server": "toy"}))
        for message in connection:
            answer = infer(unpack(message))
            connection.send(answer if isinstance(answer, str) else pack(answer))

    with server.serve(handle, "127.0.0.1", 0, compression=None, max_size=None) as running:
        Thread(target=running.serve_forever, daemon=True).start()
        yield f"ws://127.0.0.1:{running.socket.getsockname()[1]}"
        running.shutdown()


def test_messages_are_openpis() -> None:
    answer = unpack(bytes.fromhex(OF_OPENPI))
    assert answer["actions"].dtype == np.float32 and answer["n"] == 3
    np.testing.assert_array_equal(answer["actions"], [[0.5, -1.0]])
    assert pack({"a": np.arange(3, dtype=np.uint8), "prompt": "go"}).hex() == TO_OPENPI


def test_half_of_each_answer_is_executed() -> None:
    asked: list[dict] = []
    with serving(lambda m: asked.append(m) or {"actions": CHUNK + len(asked)}) as url:
        policy = ServedPolicy(f"{url}?image={ft.FRONT}", "pick it up")
        actions = [policy.act(TICK) for _ in range(5)]
    np.testing.assert_array_equal(actions, [*(CHUNK[:3] + 1), *(CHUNK[:2] + 2)])
    assert set(asked[0]) == {"image", "prompt"} and asked[0]["prompt"] == "pick it up"
    np.testing.assert_array_equal(asked[0]["image"], TICK[ft.FRONT])


def test_the_arm_holds_while_the_server_stalls() -> None:
    """The rest of the chunk is executed, then nothing moves, until the next answer."""
    calls: list[float] = []

    def stall(_: dict) -> dict:
        calls.append(time.monotonic())
        if len(calls) == 2:
            time.sleep(1.0)
        return {"actions": CHUNK}

    with serving(stall) as url:
        actor = RealTimeActor(ServedPolicy(url), timeout=0.01)
        actions = [actor.act(TICK) for _ in range(10)]
        held = actor.action_age
        actor.close()
    np.testing.assert_array_equal(actions[:6], CHUNK)
    still = np.append(np.zeros(7), CHUNK[-1, 7])
    np.testing.assert_array_equal(actions[6:], np.tile(still.astype(np.float32), (4, 1)))
    assert len(calls) == 2
    assert held == pytest.approx(4 / ft.CONTROL_HZ)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ({"actions": CHUNK[:, :7]}, r"of shape \(6, 7\); it must give \(ticks, 8\): 7 joint"),
        ({"actions": CHUNK * np.nan}, "not finite"),
        ({"action": CHUNK}, "no array of actions"),
        ("Traceback\nKeyError: 'image'", "failed: KeyError: 'image'"),
    ],
)
def test_wrong_answers_are_refused(answer: Any, message: str) -> None:
    with serving(lambda _: answer) as url, pytest.raises(UserError, match=message):
        ServedPolicy(url).act(TICK)


def test_commands_take_an_address(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit, match="deploy: no policy server answers at ws://127.0.0.1:1"):
        main(["deploy", "sim", "--policy", "ws://127.0.0.1:1", "--out", str(tmp_path / "none")])
    actions = np.zeros((8, 8), np.float32)
    with serving(lambda _: {"actions": actions}) as url:
        main(["run-policy", "--policy", f"{url}?state={ft.STATE}", "--episodes", "1", "--no-video",
              "--workers", "1", "--env.max-seconds", "1", "--out", str(tmp_path / "run")])  # fmt: skip
    assert "0/1" in capsys.readouterr().out
