"""Small sets of made-up episodes, and whether a set holds them."""

from pathlib import Path

import numpy as np

from touchgoal.control import features as ft
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter

FPS = 20
PNG_START = b"\x89PNG"
NUMERIC = (ft.STATE, ft.ACTION, ft.TRUTH_CONTACT, ft.TRUTH_PROGRESS, ft.TRUTH_SUCCESS)


def moving_blob(n: int, height: int, width: int, seed: int) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    centre = width * (0.2 + 0.6 * np.arange(n)[:, None, None] / n)
    blob = np.exp(-((x - centre) ** 2 + (y - height / 2) ** 2) / (0.02 * width * height))
    red, green, blue = np.random.default_rng(seed).uniform(20, 120, 3)
    image = np.stack([red + 100 * blob, green + 60 * blob, blue + 0 * blob], axis=-1)
    return image.astype(np.uint8)


def make_episode(seed: int, n: int = 7) -> Episode:
    rng = np.random.default_rng(seed)
    touch = rng.integers(0, 256, (2, n, 24, 32, 3), dtype=np.uint8)
    frames = {
        ft.STATE: rng.standard_normal((n, 15)).astype(np.float32),
        ft.WRIST: moving_blob(n, 32, 48, seed),
        ft.TACTILE_LEFT: touch[0],
        ft.TACTILE_RIGHT: touch[1],
        ft.ACTION: rng.standard_normal((n, 8)).astype(np.float32),
        ft.TRUTH_CONTACT: rng.random((n, 2)) < 0.5,
        ft.TRUTH_PROGRESS: np.linspace(0, 1, n, dtype=np.float32)[:, None],
        ft.TRUTH_SUCCESS: np.arange(n)[:, None] == n - 1,
    }
    meta = {"object": f"cube_{seed % 2}", "descriptions": ["hard", "smooth"][: seed % 3]}
    return Episode(
        frames, f"lift the {seed % 2}", {**meta, "seed": seed, "grasp_force": np.float64(2.5)}
    )


def record(root: Path, seeds: range, n: int = 7) -> None:
    writer = EpisodeWriter(root, FPS)
    for seed in seeds:
        writer.append(make_episode(seed, n))


def assert_holds(root: Path, seeds: list[int], n: int = 7) -> None:
    episodes = EpisodeSet(root)
    assert [episodes.meta(i)["seed"] for i in range(len(episodes))] == seeds
    for i, seed in enumerate(seeds):
        read, original = episodes.read(i), make_episode(seed, n)
        assert (read.task, read.meta) == (original.task, original.meta)
        assert set(read.frames) == set(original.frames)
        for key in (*NUMERIC, *ft.TACTILE, ft.WRIST):  # so costs are those of the raw frames
            np.testing.assert_array_equal(read.frames[key], original.frames[key], err_msg=key)
            assert read.frames[key].dtype == original.frames[key].dtype


def flip_byte(path: Path, position: int) -> None:
    data = bytearray(path.read_bytes())
    data[position] ^= 0xFF
    path.write_bytes(data)
