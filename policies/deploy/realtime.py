"""Planning while the arm moves: an inference thread, and a hand-over that skips what has gone by."""

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32

from touchgoal.control import features as ft
from touchgoal.control.errors import UserError
from touchgoal.policies.acting import Observation

_FIRST_PLAN_TIMEOUT = 20.0  # s for the first plan; it warms everything up
_CLOSE_TIMEOUT = 2.0  # s for a plan under way when the episode ends


@dataclass(frozen=True, eq=False)
class _Plan:
    tick: int  # at which its first action belongs
    actions: Float32[np.ndarray, "h 8"]


@runtime_checkable
class Horizons(Protocol):
    """What of a policy's config the hand-over needs; see `PolicyConfig`."""

    @property
    def observation_horizon(self) -> int: ...  # noqa: D102
    @property
    def execution_horizon(self) -> int: ...  # noqa: D102
    @property
    def control_hz(self) -> int: ...  # noqa: D102


@runtime_checkable
class ChunkPlanner(Protocol):
    """Anything that plans: a `Planner`."""

    @property
    def config(self) -> Horizons: ...  # noqa: D102
    def embed(self, seen: Sequence[Observation]) -> None: ...  # noqa: D102
    def plan(self, seen: Sequence[Observation]) -> Float32[np.ndarray, "h 8"]: ...  # noqa: D102


class RealTimeActor:
    """Answers within half a tick, from the newest plan; the next one is made in a thread.

    A plan that is due is waited for so long. While plans take longer they are asked for a tick
    early, and no answer waits. A plan's action k belongs to the tick k after its observation, so
    what has gone by while it was made is left out: a late plan makes no jump. If plans run out the
    arm is told to stand still, and that is counted. The first plan, which warms everything up, is
    waited for and not counted.

    Attributes:
        latencies: seconds from an observation to its plan, of every plan but the first.
        ticks_without_plan: ticks for which no plan was ready.
        action_age: s for which that has been so without a break.
        failure: what ended the planning thread, if something did; `act` raises it.
    """

    def __init__(self, planner: ChunkPlanner, timeout: float | None = None) -> None:
        """Starts an episode; `close` ends the thread.

        Args:
            planner: of this episode.
            timeout: s for which a plan that is due is waited for; None: half a tick.
        """
        self._planner, self._config = planner, planner.config
        self.latencies: list[float] = []
        self.ticks_without_plan = 0
        self.action_age = 0.0
        self.failure: BaseException | None = None
        self._sensed = -1  # tick of the newest observation that the thread has taken
        half = 0.5 / planner.config.control_hz
        self._timeout = half if timeout is None else timeout
        self._tick = -1
        self._history: list[Observation] = []
        self._observed_at = 0.0  # when the newest observation came, monotonic s
        self._plan: _Plan | None = None
        self._width = 0.0
        self._condition = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="planner", daemon=True)

    def act(self, observation: Observation) -> Float32[np.ndarray, "8"]:
        """The action for the next tick."""
        with self._condition:
            first = self._tick < 0
            self._tick += 1
            before = self._history or [observation] * self._config.observation_horizon
            self._history = [*before[1:], observation]
            self._observed_at = time.monotonic()
            self._condition.notify_all()
            if first:
                self._thread.start()
                if not self._condition.wait_for(self._has_plan, _FIRST_PLAN_TIMEOUT):
                    raise UserError(
                        f"the policy made no plan in {_FIRST_PLAN_TIMEOUT:.0f} s: make it smaller"
                    )
            elif not self._slow and self._due():
                self._condition.wait_for(self._plan_not_due, self._timeout)
            if self.failure is not None:
                raise self.failure
            return self._action()

    def close(self) -> None:
        """Ends the thread; one that hangs is left behind."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()
        if self._thread.is_alive():
            self._thread.join(_CLOSE_TIMEOUT)

    def _action(self) -> np.ndarray:
        assert self._plan is not None
        k = self._tick - self._plan.tick
        if k < len(self._plan.actions):
            action = self._plan.actions[k]
            self._width = float(action[ft.N_JOINTS])
            self.action_age = 0.0
            return action
        self.ticks_without_plan += 1
        self.action_age += 1 / self._config.control_hz
        return np.append(np.zeros(ft.N_JOINTS), self._width).astype(np.float32)

    def _plan_not_due(self) -> bool:
        return self._closed or self.failure is not None or not self._due()

    def _has_plan(self) -> bool:
        return self._plan is not None or self.failure is not None

    def _work(self) -> None:
        torch.set_num_threads(1)  # of this thread; two lose badly when the other core is taken
        try:
            while (task := self._wait()) is not None:
                tick, seen, asked, due = task
                if not due:
                    self._planner.embed(seen)
                    continue
                actions = self._planner.plan(seen)
                with self._condition:
                    if self._plan is not None:
                        self.latencies.append(time.monotonic() - asked)
                    self._plan = _Plan(tick, actions)
                    self._condition.notify_all()
        except BaseException as error:
            with self._condition:
                self.failure = error
                self._condition.notify_all()

    def _wait(self) -> tuple[int, list[Observation], float, bool] | None:
        """What to plan from, if a plan is due, or to sense, if the next plan sees it, too."""
        with self._condition:
            seen = self._config.observation_horizon - 1
            self._condition.wait_for(
                lambda: self._due() or (self._sensed < self._tick and self._due(seen))
            )
            self._sensed = self._tick
            return (
                None
                if self._closed
                else (self._tick, [*self._history], self._observed_at, self._due())
            )

    @property
    def _slow(self) -> bool:
        return bool(self.latencies) and self.latencies[-1] > self._timeout

    def _due(self, ahead: int = 0) -> bool:
        """Whether it is time for another plan, or will be in some ticks; or for the end."""
        if self._closed or self._plan is None:
            return self._closed or self._tick >= 0
        # At least one tick on: from the same observation the thread would plan again and again.
        horizon = max(1, self._config.execution_horizon - self._slow)
        return self._tick + ahead - self._plan.tick >= horizon
