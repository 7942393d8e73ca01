"""Speed of a simulated pad on one core, beside the machine's limit and a peer."""

import os
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, no_type_check

import numpy as np
from numba import njit

from benchmarks.options import BenchmarkOptions
from benchmarks.real_touch.taxim_peer import has_jax, has_taxim
from benchmarks.speed.rates import Row, measure, one_core, table
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI_MARKERS, SensorModel
from touchgoal.runtime.errors import install_extra
from touchgoal.runtime.option_types import Count, checked_dataclass
from touchgoal.sim_envs.config import NO_RANDOMIZATION
from touchgoal.sim_envs.scene.objects import CATALOGUE, HARD, Body, Material, Texture
from touchgoal.sim_envs.tactile.rig.press_bench import PressBench
from touchgoal.sim_envs.tactile.sensor_instance import SensorInstance, sample_instance


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark tactile-speed."""

    repeats: Count = 7
    """Measurements of each figure; the median is printed."""
    frames: Count = 100
    """Frames in a measurement."""


# Least work of one 240x320 frame of a ball, counted by hand from the kernels: multiplications and
# additions, and bytes through the first-level cache.
FRAME_FLOP = 19_200 * (2 * 25 + 3 * 60 + 60) + 76_800 * 3 * 9
FRAME_BYTES = 19_200 * 4 * 45 + 76_800 * 3 * (2 + 1 + 1 + 2)
_TEXTURED = Material(Texture.DOTTED, 40e-6, 1.5e-3, HARD, 0.8, (0.7, 0.7, 0.7, 1.0))


def run(config: Config) -> dict[str, Any]:
    """Measure everything on one core, in processor time, which other processes distort least."""
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
    with one_core():
        rows = [*_ours(config), *_peer(config)]
        limits = _limits(config)
    return {"rows": [vars(row) for row in rows], **limits, "table": _table(rows, limits)}


def _ours(config: Config) -> list[Row]:
    full = GELSIGHT_MINI_MARKERS
    half = replace(full, image_shape=(120, 160), pixel_pitch=2 * full.pixel_pitch)
    rows = []
    for sensor in (full, half):
        h, w = sensor.image_shape
        for name, body, distance in _bodies():
            textured = replace(body.kind, material=_TEXTURED)
            for what, kind in (("smooth", body.kind), ("textured", textured)):
                bench = PressBench(replace(body, kind=kind), sensor, _instance(sensor))
                bench.place(np.array([1e-3, -0.5e-3, distance - 5e-4]))
                rows.append(_measure(f"{h}x{w} {name}, {what}", config, _frame(bench)))
        bench = PressBench(_bodies()[0][1], sensor, _instance(sensor))
        rows.append(_measure(f"{h}x{w} untouched", config, _frame(bench, force=0.0)))
    return rows


def _frame(bench: PressBench, force: float = 8.0) -> Callable[[], object]:
    """Return a function that renders all stages of a frame."""
    rng = np.random.default_rng(0)
    return lambda: bench.sense(force, rng, shear=(1.5, 0.5), centre=(1e-3, -0.5e-3))


def _instance(sensor: SensorModel) -> SensorInstance:
    instance = sample_instance(GELSIGHT_MINI_MARKERS, np.random.default_rng(0), NO_RANDOMIZATION)
    if sensor.image_shape == instance.background.shape[1:]:
        return instance
    return replace(
        instance,
        calibration=replace(instance.calibration, pixel_pitch=sensor.pixel_pitch),
        background=instance.background[:, ::2, ::2].copy(),
        illumination=instance.illumination[:, ::2, ::2].copy(),
        markers=instance.markers / 2,
        marker_radius=instance.marker_radius / 2,
    )


def _bodies() -> list[tuple[str, Body, float]]:
    """Yield name, body, and height of its centre above its near side, m."""
    ball, pebble = CATALOGUE["glass_ball"], CATALOGUE["pebble"]
    can = replace(ball, shape="cylinder")
    box, rod = replace(ball, shape="box"), replace(ball, shape="capsule")
    radius = 0.012
    small, large = (_sphere_points(n) * radius for n in (642, 10_242))
    return [
        ("ball", Body(ball, (radius,), 0.1), radius),
        ("cylinder, lying", Body(can, (0.01, 0.02), 0.1), 0.02),
        ("box", Body(box, (0.006, 0.005, 0.01), 0.1), 0.01),
        ("capsule", Body(rod, (0.006, 0.01), 0.1), 0.006),
        ("mesh of 1,280 triangles", Body(pebble, (1.0,), 0.1, hull=small), radius),
        ("mesh of 20,480 triangles", Body(pebble, (1.0,), 0.1, hull=large), radius),
    ]


def _sphere_points(n: int) -> np.ndarray:
    """Return n points spread evenly over the unit sphere; their hull has 2 n - 4 triangles."""
    k = np.arange(n) + 0.5
    z, turn = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], 1)


def _peer(config: Config) -> list[Row]:
    """Return Taxim's JAX port with its own Mini calibration and a ball, where it is installed."""
    if not (has_taxim() and has_jax()):
        print(f"no peer; to measure taxim beside us: {install_extra('peers')}")
        return []
    from taxim import CALIB_GELSIGHT_MINI, Taxim  # pyright: ignore[reportMissingImports]

    simulator = Taxim(calib_folder=CALIB_GELSIGHT_MINI, backend="jax", device="cpu")
    x, y = np.meshgrid(np.arange(640) - 319.5, np.arange(480) - 239.5)
    square = 12.0**2 - (0.0295 * x) ** 2 - (0.0295 * y) ** 2
    height = (12.0 - np.sqrt(np.maximum(square, 0)) - 0.5).astype(np.float32)  # mm
    fewer = replace(config, frames=max(config.frames // 50, 1), repeats=min(config.repeats, 3))
    rows = []
    for what, shadow in (("without shadows", False), ("with shadows", True)):

        def render(shadow: bool = shadow) -> None:
            np.asarray(simulator.render(height, with_shadow=shadow))

        name = f"480x640 peer: taxim 1.4.1 (JAX), {what}, no force, no dots"
        rows.append(_measure(name, fewer, render, clock=time.process_time))
    return rows


def _measure(
    what: str,
    config: Config,
    work: Callable[[], object],
    clock: Callable[[], float] = time.thread_time,
) -> Row:
    """Return the rate of one `work` out of many in a row."""

    def frames() -> None:
        for _ in range(config.frames):
            work()

    return measure(what, config.repeats, config.frames, frames, clock)


def _limits(config: Config) -> dict[str, float]:
    # Alignment of the two arrays changes it tenfold on some machines.
    copied = max(_copy_rate(config, offset) for offset in (0, 16, 1024))
    chain = partial(_chain, _LANES, _FMA_STEPS)
    flop = _measure("fma", replace(config, frames=20), chain).median * _FMA_FLOP
    return {
        "copy_gb_per_s": copied / 1e9,
        "gflop_per_s": flop / 1e9,
        "memory_limit_fps": copied / FRAME_BYTES,
        "arithmetic_limit_fps": flop / FRAME_FLOP,
    }


def _copy_rate(config: Config, offset: int) -> float:
    """Return bytes read and written a second by copies of 256 kB, as large as a frame's arrays."""
    source = np.ones((1 << 16) + offset, np.float32)[offset:]
    target = np.ones(1 << 16, np.float32)
    copies = replace(config, frames=2000)
    return _measure("", copies, lambda: np.copyto(target, source)).median * 2 * source.nbytes


_FMA_STEPS = 1 << 14
_FMA_FLOP = _FMA_STEPS * 128 * 2
_LANES = np.full(128, 0.5, np.float32)


@njit(cache=True, fastmath=True)
@no_type_check
def _chain(lanes, steps):
    for _ in range(steps):
        for k in range(128):
            lanes[k] = lanes[k] * np.float32(0.999) + np.float32(0.0005)


def _table(rows: list[Row], limits: dict[str, float]) -> str:
    ball = next(row for row in rows if row.what.startswith("240x320 ball"))
    rates = table("one core, processor time", "frames/s", rows)
    return (
        f"{rates}\nthis core copies {limits['copy_gb_per_s']:.0f} GB/s and does "
        f"{limits['gflop_per_s']:.0f} GFLOP/s: a 240x320 frame cannot be faster than "
        f"{limits['memory_limit_fps']:,.0f}/s by memory, {limits['arithmetic_limit_fps']:,.0f}/s "
        f"by arithmetic; the ball reaches "
        f"{ball.median * (1 / limits['memory_limit_fps'] + 1 / limits['arithmetic_limit_fps']):.0%}"
        " of both one after the other"
    )
