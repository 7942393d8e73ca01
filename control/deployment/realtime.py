"""Planning while the arm moves: a planning thread, and a hand-over that skips the ticks gone by."""

import threading
import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor, Planner
from touchgoal.control.motion.tracker import ServoLag
from touchgoal.control.teleoperation.teleoperator import YieldingHand
from touchgoal.runtime.errors import UserError

_FIRST_PLAN_TIMEOUT = 20.0  # s for the first plan; it warms everything up
_CLOSE_TIMEOUT = 2.0  # s for a plan under way when the episode ends


@dataclass(frozen=True, eq=False)
class _Plan:
    tick: int  # tick of its observation, and of its first action
    end: int  # first tick of the next plan
    actions: Float32[np.ndarray, "h 8"]


@dataclass(frozen=True, eq=False)
class _Request:
    tick: int  # of the newest observation
    observations: list[Observation]
    at: float  # monotonic s of the newest


class RealTimeActor(Actor):
    """Actor that answers at once from the newest plan, while a thread makes the next one.

    A plan is used from the tick after its observation's. It is requested one tick early, so that it
    has a whole tick to be made and actions do not depend on the machine's speed. Action k belongs
    to the tick k after the observation, so a late plan makes no jump; if plans run out the arm
    stands still. A plan no longer than its executed part is requested only when needed.
    """

    def __init__(
        self,
        planner: Planner,
        timeout: float | None = None,
        lag: ServoLag | None = None,
        hand: YieldingHand | None = None,
    ) -> None:
        """Begin an episode of the planner; `close` ends the thread.

        Args:
            timeout: time to wait for a late plan, s; None: half a tick.
            lag: delay of the servo that the policy was trained on; an arm that follows at once reacts
                sooner. Joint changes that it still holds back count as commanded.
            hand: yields to what it presses on; not with `lag`.
        """
        self._planner, self._hand, self.recovers = planner, hand, planner.recovers
        # s from an observation to its plan, without the first plan
        self.latencies: list[float] = []
        self._lag = lag
        self._before: np.ndarray | None = None  # joints (rad) wanted at the last tick
        self.failure: BaseException | None = None  # ended the planning thread; `act` raises it
        half = 0.5 / planner.control_hz
        self._timeout = half if timeout is None else timeout
        self._tick = self._embedded = -1
        self._history: list[Observation] = []
        self._request: _Request | None = None  # for the plan that is being made
        self._lead = 0  # ticks between a plan's observation and the first tick that it is meant for
        self._plan: _Plan | None = None
        self._width = 0.0
        self._condition = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="planner", daemon=True)

    def start(self, observation: Observation) -> None:
        """Make the first plan, which warms everything up, at rest; UserError if none in 20 s."""
        if self._hand is not None:
            self._hand.start(observation)
        with self._condition:
            self._history = [observation] * self._planner.history_ticks
            self._request = _Request(0, self._history, time.monotonic())
            self._thread.start()
            if not self._condition.wait_for(self._no_request, _FIRST_PLAN_TIMEOUT):
                raise UserError(
                    f"the policy made no plan in {_FIRST_PLAN_TIMEOUT:.0f} s: make it smaller"
                )
            if self.failure is not None:
                raise self.failure

    def act(self, observation: Observation) -> Float[np.ndarray, "8"]:
        """Return the action for this tick, as `lag` and `hand` change it."""
        self.done, self.given_up = self._planner.done, self._planner.given_up
        if self._hand is not None:
            return self._hand.add_to(self._answer(observation), observation)
        if self._lag is None:
            return self._answer(observation)
        q = observation[ft.COMMAND][: ft.N_JOINTS] + self._lag.remaining
        velocity = (q - (q if self._before is None else self._before)) * self._planner.control_hz
        self._before = q
        wanted = np.concatenate([q, velocity]).astype(np.float32)
        action = self._answer({**observation, ft.COMMAND: wanted})
        return np.append(self._lag.update(action[:-1]), action[-1])

    def close(self) -> None:
        """End the thread; one that hangs is left behind."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()
        if self._thread.is_alive():
            self._thread.join(_CLOSE_TIMEOUT)

    def _answer(self, observation: Observation) -> Float32[np.ndarray, "8"]:
        if not self._history:
            self.start(observation)
        with self._condition:
            self._tick += 1
            self._history = [*self._history[1:], observation]
            if self._request:  # the requested plan is due at this tick
                self._condition.wait_for(self._no_request, self._timeout)
            if self._request is None and self._due():
                self._request = _Request(self._tick, self._history, time.monotonic())
            self._condition.notify_all()
            if self._lead == 0:
                self._condition.wait_for(self._no_request, self._timeout)
            if self.failure is not None:
                raise self.failure
            return self._action()

    def _due(self, ahead: int = 0) -> bool:
        """Return whether the next plan must be asked for, now or `ahead` ticks from now."""
        assert self._plan is not None
        return self._tick > self._plan.tick and (self._tick + ahead + self._lead >= self._plan.end)

    def _action(self) -> Float32[np.ndarray, "8"]:
        assert self._plan is not None
        k = self._tick - self._plan.tick
        if k < len(self._plan.actions):
            action = self._plan.actions[k]
            self._width = float(action[ft.N_JOINTS])
            self.action_age = 0.0
            return action
        self.action_age += 1 / self._planner.control_hz
        return np.append(np.zeros(ft.N_JOINTS), self._width).astype(np.float32)

    def _no_request(self) -> bool:
        return self._closed or self.failure is not None or self._request is None

    def _work(self) -> None:
        try:
            while (work := self._next_work()) is not None:
                if isinstance(work, _Request):
                    self._take(work, self._planner.plan(work.observations))
                else:
                    self._planner.embed(work)
        except BaseException as error:
            with self._condition:
                self.failure = error
                self._condition.notify_all()

    def _take(self, request: _Request, actions: Float32[np.ndarray, "h 8"]) -> None:
        """Store a finished plan for `act`."""
        horizon = self._planner.execution_horizon
        with self._condition:
            end = request.tick + horizon
            if self._plan is None:
                self._lead = int(len(actions) > horizon)
            else:
                self.latencies.append(time.monotonic() - request.at)
                end += self._lead
            self._plan, self._request = _Plan(request.tick, end, actions), None
            self._condition.notify_all()

    def _next_work(self) -> _Request | list[Observation] | None:
        """Wait for a plan's request, or observations of the next plan to embed; None at the end."""
        ahead = self._planner.observation_horizon - 1

        def to_embed() -> bool:
            return self._embedded < self._tick and self._due(ahead)

        with self._condition:
            self._condition.wait_for(lambda: self._closed or self._request or to_embed())
            self._embedded = self._tick
            return None if self._closed else self._request or self._history
