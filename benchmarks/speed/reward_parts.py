"""Time of a reward's cost on one core, by part and whole, with two cameras and two fingertips."""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from benchmarks.speed.rates import in_turn
from touchgoal.control.features import (
    CAMERA_SHAPE,
    CAMERAS,
    CONTROL_HZ,
    TACTILE,
    TACTILE_SHAPE,
    WRENCH,
)
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI
from touchgoal.encoders.pretrained import load_encoder
from touchgoal.encoders.towers.towers import OfflineTowers
from touchgoal.rewards.features.contact_reading import ContactReader
from touchgoal.rewards.features.embedder import EpisodeEmbedder, Frames
from touchgoal.rewards.value import Value, ValueConfig

_BATCH = 32  # frames of a recording at once
_WHOLE = "a frame with both cameras and fingertips, "


@torch.inference_mode()
def time_parts(repeats: int) -> dict[str, float]:
    """Return processor time in ms a frame, with the shipped encoder and both fingertips pressed."""
    frames, gel = _frames()
    towers, encoder = OfflineTowers(), load_encoder("gelsight_mini")
    reader = ContactReader(GELSIGHT_MINI, gel[:5], CONTROL_HZ)
    stream = EpisodeEmbedder(towers, encoder).stream(
        {side: gel for side in TACTILE} | {key: frames[key][: len(gel)] for key in CAMERAS},
        CONTROL_HZ,
        "noise",
    )
    one = {key: value[:1] for key, value in frames.items()}
    pressed, image = one[TACTILE[0]], one[CAMERAS[0]]
    maps = towers.embed_with_maps(image)[1]
    value = Value(ValueConfig("", CAMERAS, "offline", maps.shape[1:], 0)).eval()
    stacked = torch.from_numpy(maps).float().flatten(2)[:, None].expand(-1, len(CAMERAS), -1, -1)
    work: dict[str, tuple[Callable[[], object], int]] = {
        "a camera, pooled and at stride 16": (partial(towers.embed_with_maps, image), 1),
        "touch of a fingertip": (partial(encoder.embed_frames, pressed, gel[0]), 1),
        "contact, force, centre and slip of a fingertip": (partial(reader.read, pressed), 1),
        "value of both cameras": (partial(value, stacked), 1),
        _WHOLE + "on line": (partial(stream.embed, one), 1),
        _WHOLE + f"{_BATCH} at once": (partial(stream.embed, frames), _BATCH),
    }
    times = in_turn([run for run, _ in work.values()], repeats)
    counts = [count for _, count in work.values()]
    return {
        name: 1e3 * seconds / count
        for name, seconds, count in zip(work, times, counts, strict=True)
    }


def _frames() -> tuple[Frames, np.ndarray]:
    """Return frames of noise with something pressed into both fingertips, and untouched ones."""
    rng = np.random.default_rng(0)
    gel = rng.integers(108, 112, (6, *TACTILE_SHAPE), np.uint8)
    pressed = np.repeat(gel[:1], _BATCH, 0)
    pressed[:, 100:140, 140:180, 0] += 60
    frames = {key: rng.integers(0, 256, (_BATCH, *CAMERA_SHAPE), np.uint8) for key in CAMERAS}
    frames |= dict.fromkeys(TACTILE, pressed)
    return frames | {WRENCH: np.zeros((_BATCH, 6), np.float32)}, gel


def parts_table(times: dict[str, float]) -> str:
    """Return the times as text, and frames a second of the whole."""
    lines = ["reward, ms per frame:", *(f"  {name:<56}{ms:>8.2f}" for name, ms in times.items())]
    whole = {
        name.removeprefix(_WHOLE): 1e3 / ms for name, ms in times.items() if name.startswith(_WHOLE)
    }
    rates = ", ".join(f"{rate:.0f} {name}" for name, rate in whole.items())
    return "\n".join([*lines, f"  frames a second: {rates}"])
