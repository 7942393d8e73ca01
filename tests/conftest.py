"""Shared by all tests: one thread, no network; the twins and the toy episodes that several files use."""

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["LP_NUM_THREADS"] = "0"

import jaxtyping  # noqa: E402
import pytest  # noqa: E402
import torch  # noqa: E402
from checked_types import jaxtyped  # noqa: E402
from hypothesis import settings  # noqa: E402

jaxtyping.jaxtyped = jaxtyped  # what --jaxtyping-packages decorates with
from in_process import in_process_workers  # noqa: E402
from running_twin import RunningTwin  # noqa: E402
from toy_episodes import record  # noqa: E402

torch.set_num_threads(1)
# The same examples in every run; --hypothesis-profile default searches for others.
settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")
# A shell that starts the tests in the background ignores Ctrl-C, for them and all their children.
signal.signal(signal.SIGINT, signal.default_int_handler)

_CELL = ["--env.objects", "wooden_block", "--seed", "3", "--no-wrench-error"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The slow ones first: at the end one of them would keep a single core busy for minutes.

    Without a GPU, what needs one is skipped.
    """
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)
    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("gpu"):
                item.add_marker(pytest.mark.skip("needs a CUDA device"))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With `-m realtime`, skip files without such tests: reading them all takes seconds."""
    alone = config.option.markexpr == "realtime" and collection_path.suffix == ".py"
    return True if alone and "realtime" not in collection_path.read_text() else None


@pytest.fixture
def in_process() -> Iterator[None]:
    with in_process_workers():
        yield


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of the test's own, in which it stands."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def fr3(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningTwin]:
    """An FR3 that waits for its client, so that runs repeat."""
    arguments = ["--arm", "fr3", "--lock-step", *_CELL]
    twin = RunningTwin(arguments, tmp_path_factory.mktemp("fr3"), 0)
    yield twin
    twin.close()


@pytest.fixture(scope="session")
def ur5e(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningTwin]:
    """A UR5e in real time; touch is left out, for it takes time."""
    arguments = ["--arm", "ur5e", *_CELL, "--env.cameras", "front", "--env.no-tactile"]
    twin = RunningTwin(arguments, tmp_path_factory.mktemp("ur5e"), 1)
    yield twin
    twin.close()


@pytest.fixture(scope="module")
def recorded_small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of three toy episodes that no test changes."""
    root = tmp_path_factory.mktemp("small") / "episodes"
    record(root, range(3))
    return root


@pytest.fixture
def small(recorded_small: Path, tmp_path: Path) -> Path:
    """A copy of it that a test may change."""
    return shutil.copytree(recorded_small, tmp_path / "set")
