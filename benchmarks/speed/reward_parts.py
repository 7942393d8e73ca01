"""Time of each part of a reward's cost on one core, for one frame."""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from touchgoal.benchmarks.speed.rates import in_turn
from touchgoal.control.features import CAMERA_SHAPE, CAMERAS, CONTROL_HZ, TACTILE_SHAPE
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI
from touchgoal.encoders.towers.towers import OfflineTowers
from touchgoal.rewards.features.contact_reading import ContactReader
from touchgoal.rewards.value.value import Value, ValueConfig


@torch.inference_mode()
def time_parts(repeats: int) -> dict[str, float]:
    """Return processor time in ms: of one camera, of one fingertip pressed, and of the value."""
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (1, *CAMERA_SHAPE), np.uint8)
    gel = rng.integers(108, 112, (6, *TACTILE_SHAPE), np.uint8)
    pressed = gel[:1].copy()
    pressed[:, 100:140, 140:180, 0] += 60
    towers, reader = OfflineTowers(), ContactReader(GELSIGHT_MINI, gel[:5], CONTROL_HZ)
    maps = towers.embed_with_maps(picture)[1]
    value = Value(ValueConfig("", CAMERAS, "offline", maps.shape[1:], 0)).eval()
    stacked = torch.from_numpy(maps).float().flatten(2)[:, None].expand(-1, len(CAMERAS), -1, -1)
    work: dict[str, Callable[[], object]] = {
        "a camera, pooled and at stride 16": partial(towers.embed_with_maps, picture),
        "contact, force and centre of a fingertip": partial(reader.read, pressed),
        "value of both cameras": partial(value, stacked),
    }
    return {
        name: 1e3 * seconds
        for name, seconds in zip(work, in_turn(list(work.values()), repeats), strict=True)
    }


def parts_table(times: dict[str, float]) -> str:
    """Return the times as text."""
    lines = ["parts of a reward, ms per frame (an embedded touch: the tick above):"]
    return "\n".join([*lines, *(f"  {name:<42}{ms:>8.2f}" for name, ms in times.items())])
