"""A real wand in a person's hand: cameras over MJPEG, the load cell on a pseudo-terminal.

The person reads the terminal, presses as it says, and lifts when it says so.
"""

import io
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from in_process import in_process_workers
from numbered_images import until

from touchgoal.control import features as ft
from touchgoal.control.cell.wand import WandReading
from touchgoal.control.cell.wand_recorder import WandRecorder
from touchgoal.control.sensors.live_image import StreamServer
from touchgoal.control.sensors.load_cell import with_checksum
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI
from touchgoal.control.wand_touch import FORCE_RANGES, MAX_FORCE, WandTouch
from touchgoal.encoders.alignment.wand_set import WandSet
from touchgoal.episodes.store import EpisodeSet
from touchgoal.episodes.wand import recording as wand_recording
from touchgoal.launch.__main__ import main
from touchgoal.sim_envs.touch_wand import TouchWand
from touchgoal.sim_envs.twin.image_process import Stream
from touchgoal.sim_envs.twin.serial.devices import SerialPort
from touchgoal.sim_envs.wand.objects import find_wand_object

VIEWS = [key.removeprefix(ft.IMAGE_PREFIX) for key in ft.WAND_VIEWS]


@pytest.fixture(scope="module")
def ramp() -> np.ndarray:
    """The gel's images at 0, 4, 8, 12, 16 and 20 N."""
    env = TouchWand(object="screw", views=False)
    env.reset(seed=3)
    touch = None
    while touch is None:
        action = env.random_action()
        action[5] = 1.0
        touch = env.touch(action)
    env.close()
    return touch.clip


class Person(threading.Thread):
    """A wand's devices, and the hand that holds it; `silent` stops the load cell."""

    def __init__(self, folder: Path, ramp: np.ndarray) -> None:
        super().__init__(daemon=True)
        self.streams = {name: Stream() for name in ("gel", *VIEWS)}
        self.server = StreamServer(self.streams, "127.0.0.1", 0)
        self.port, self.silent = SerialPort(folder / "load_cell"), False
        self.gone, self.interrupt_after = False, ""
        self.ramp, self.screen, self._rng = ramp, io.StringIO(), np.random.default_rng(0)
        self._force = self._goal = 0.0
        self.file = folder / "wand.toml"
        url = f"http://127.0.0.1:{self.server.port}"
        cameras = "".join(f'{name} = {{ source = "{url}/{name}" }}\n' for name in VIEWS)
        self.file.write_text(
            f'[gel]\nsource = "{url}/gel"\n[cameras]\n{cameras}[load_cell]\n'
            f'port = "{self.port.path}"\nnewtons_per_count = 0.01\nzero = 1000.0\n'
        )
        self.start()

    def run(self) -> None:
        tick = 0
        while not self.gone:
            tick += 1
            self._obey(["", *self.lines][-1])
            force = max(self._force, 0.0)
            pressed = self.ramp[int(np.ceil(force / MAX_FORCE * 5))]
            image = pressed + self._rng.normal(0, 1, pressed.shape)
            self.streams["gel"].publish(np.clip(image, 0, 255).astype(np.uint8))
            light = 160 if force > 0 else 60
            for name in VIEWS:
                view = light + self._rng.normal(0, 3, (64, 80, 3))
                self.streams[name].publish(view.astype(np.uint8))
            if not self.silent:  # 0.4 N: the head's weight
                counts = round(1000 + (force + 0.4) / 0.01 + self._rng.normal())
                self.port.write(with_checksum(b"%d,%d" % (tick, counts), "crc16") + b"\r\n")
            time.sleep(0.02)

    @property
    def lines(self) -> list[str]:
        """Lines printed so far."""
        return [line for line in self.screen.getvalue().split("\n") if line]

    def _obey(self, hint: str) -> None:
        if wanted := re.match(r"press with (\d+) to (\d+) N", hint):
            self._goal = (float(wanted[1]) + float(wanted[2])) / 2 + 0.6
        elif hint != "hold":
            self._goal = 0.0
        step = self._goal / 12 if self._goal else -4.0
        self._force = float(np.clip(self._force + step, 0, self._goal or self._force))
        self._force = self._force if self._goal or self._force > 0.5 else 0.0
        if self.interrupt_after and any(self.interrupt_after in x for x in self.lines):
            self.interrupt_after = ""
            os.kill(os.getpid(), signal.SIGINT)

    def when_asked_to_press(self, act: Callable[[], None]) -> None:
        def wait() -> None:
            until(lambda: any(line.startswith("press with") for line in self.lines))
            act()

        threading.Thread(target=wait, daemon=True).start()

    def leave(self) -> None:
        self.gone = True
        self.join()
        self.server.close()
        self.port.unplug()


@pytest.fixture
def person(tmp_path: Path, ramp: np.ndarray) -> Iterator[Person]:
    someone = Person(tmp_path, ramp)
    yield someone
    someone.leave()


def collect(person: Person, out: Path, *options: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", person.screen)
        main(["collect-touches", "--wand", str(person.file), "--out", str(out), *options])


def test_three_touches_are_recorded_as_the_twins_and_ctrl_c_loses_nothing(
    person: Person, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    collect(person, out, "--object", "screw", "--episodes", "3")
    found = EpisodeSet(out / "episodes")
    meta = [found.meta(i) for i in range(3)]
    assert len(found) == 3
    forces = sorted(float(m["force"]) for m in meta)  # pyright: ignore[reportArgumentType]
    assert all(low < f <= high for f, (low, high) in zip(forces, FORCE_RANGES, strict=True))
    assert meta[0]["descriptions"] == list(find_wand_object("screw").descriptions)
    assert [m["gel_wear"] for m in meta] == ["", "", ""]
    frames = found.read(0).frames
    load = frames[ft.LOAD][:, 0]
    assert load[0] == 0 and (np.diff(load) > 0).all() and load[-1] == pytest.approx(forces[0])
    view = frames[ft.WAND_VIEWS[0]].mean((1, 2, 3))
    np.testing.assert_allclose(view, [60, 60, 160, 160, 160, 160], atol=3)
    untouched, touched = WandSet.open(found.root).images(2)
    assert np.abs(untouched.astype(float) - person.ramp[0]).mean() < 2
    assert np.abs(touched.astype(float) - untouched).max() > 20

    monkeypatch.setattr(wand_recording, "TOUCHES_A_VISIT", 1)
    with in_process_workers():
        twin = wand_recording.record_touches(tmp_path / "twin", "gelsight_mini", 0, 1, 1)
    assert set(twin.meta(0)) == set(meta[0]) and twin.fps == found.fps
    keys = {key for key in twin.features if not key.startswith("truth.")}
    assert keys == set(found.features)
    assert all(twin.features[key]["shape"] == found.features[key]["shape"] for key in keys)

    person.screen = io.StringIO()
    person.interrupt_after = "recorded 1:"
    collect(person, out, "--object", "mug", "--description", "smooth and hard", "--new-gel")
    more = EpisodeSet(out / "episodes")
    assert len(more) in (4, 5)  # the touch in hand, too, if it was held
    last = more.meta(3)
    assert (last["object"], last["gel"], last["visit"]) == ("mug", 1, 1)
    assert last["descriptions"] == ["smooth and hard"]


def test_a_lost_camera_is_waited_for(person: Person, tmp_path: Path) -> None:
    def lose() -> None:
        person.streams["side_left"].lost = time.monotonic() + 1.5

    person.when_asked_to_press(lose)
    collect(person, tmp_path / "run", "--object", "screw", "--episodes", "1")
    lost = [line for line in person.lines if line.startswith("side_left: ")]
    assert lost and "check its cable" in lost[0]
    assert len(EpisodeSet(tmp_path / "run" / "episodes")) == 1


def test_a_silent_load_cell_is_said(person: Person, tmp_path: Path) -> None:
    person.silent = True
    with pytest.raises(SystemExit, match="load cell .* gives nothing: check cable, power"):
        collect(person, tmp_path / "run", "--object", "screw")
    person.silent = False

    def fall_silent() -> None:
        person.silent, person.interrupt_after = True, "load cell: nothing new for"

    person.when_asked_to_press(fall_silent)
    with pytest.raises(SystemExit, match="no touch was recorded"):
        collect(person, tmp_path / "run", "--object", "screw")


class Hand:
    """Feeds a recorder with readings of a press; the gel may have a scratch."""

    def __init__(self, ramp: np.ndarray) -> None:
        self.recorder, self.scratch = WandRecorder(GELSIGHT_MINI), 0
        self._ramp, self._rng = ramp, np.random.default_rng(0)

    def feel(self, *forces: float, shown: float | None = None) -> list[WandTouch | str]:
        """Return the touches, and why others do not count; `shown`: force that the image shows."""
        made = []
        for force in forces:
            seen = min(force, MAX_FORCE) if shown is None else shown
            image = self._ramp[int(np.ceil(seen / 4))] + self._rng.normal(0, 1, (240, 320, 3))
            image[100:102, 60:160] += self.scratch
            view = {"top": np.full((2, 2, 3), int(force > 0), np.uint8)}
            reading = WandReading(np.clip(image, 0, 255).astype(np.uint8), view, float(force) + 0.4)
            made.append(self.recorder.update(reading))
        return [one for one in made if one is not None]


def test_a_touch_that_does_not_count_is_said(ramp: np.ndarray) -> None:
    hand = Hand(ramp)
    hand.feel(*[0.0] * 15)
    assert "too quick" in str(hand.feel(*[8.0] * 2, *[0.0] * 15))
    assert "too hard" in str(hand.feel(*np.linspace(1, 22, 12), *[22.0] * 6, *[0.0] * 15))
    hand.feel(*[5.0] * 10, shown=0.0)
    assert "the gel shows nothing" in hand.recorder.hint
    hand.feel(*[0.0] * 30)
    hand.feel(*[0.0] * 10, shown=8.0)
    assert "the load cell reads nothing" in hand.recorder.hint
    hand.feel(*[0.0] * 3)
    hand.feel(*np.linspace(1, 8, 8), *[8.0] * 6)
    assert hand.recorder.hint == "lift"
    made = hand.recorder.finish()  # Ctrl-C before the lift
    assert made is not None and made.load[-1] == pytest.approx(8.0, abs=0.05)
    assert made.before["top"].max() == 0 and made.views["top"].min() == 1
