"""What the audit of policies lets them feel in place of their touch."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from benchmarks.deployment import audit
from benchmarks.deployment.trials import UNCHANGED
from touchgoal.control.features import TACTILE
from touchgoal.control.interfaces import Actor
from touchgoal.episodes.recording import EpisodeSpec
from touchgoal.sim_envs.config import FragileCarryConfig

TICKS = 8


def test_each_row_changes_touch_as_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    felt: list[list[tuple[int, int, int]]] = []  # run -> tick -> seed, tick, side of the left image

    class Feels(Actor):
        def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
            felt[-1].append(tuple(observation[TACTILE[0]]))
            return np.zeros(8)

    def run_trial(_: Any, make: Callable[[Any], Actor], spec: EpisodeSpec) -> str:
        felt.append([])
        actor = make(None)
        for tick in range(TICKS - spec.seed):  # the other run is shorter
            actor.act({key: np.array([spec.seed, tick, i]) for i, key in enumerate(TACTILE)})
        return str(spec.seed)

    monkeypatch.setattr(audit, "run_trial", run_trial)
    rows = audit._audit(FragileCarryConfig(), lambda _: Feels(), (EpisodeSpec(0), EpisodeSpec(3)))
    own = [(0, tick, 0) for tick in range(TICKS)]
    by_name = dict(zip(rows, [felt[0], *felt[2:]], strict=True))
    assert by_name[UNCHANGED] == own
    assert by_name["removed"] == [own[0]] * TICKS
    assert by_name["shuffled"] != own and sorted(by_name["shuffled"]) == own
    assert by_name["of another episode"] == [(3, min(tick, 4), 0) for tick in range(TICKS)]
    assert by_name["of the other fingertip"] == [(0, tick, 1) for tick in range(TICKS)]
