"""Check by ground truth that a simulated episode of pick-place came out as it was asked to."""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from touchgoal.control import features as ft
from touchgoal.sim_envs.config import Outcome

_LIFTED = 0.03  # m
_TOLERANCE = 0.02  # m: largest distance of a success from the goal
_OVERGRIPPED = (36.0, 44.0)  # N of each finger
_PRESSED = 20.0  # N upwards on the hand: the 120 successes of `TASK_FORCES` reach 16.5 N
_OFF_CENTRE = 0.004  # m in the hand; successes stay within 0.003
_SLID = 0.004  # m in the hand between lifting and the end


class Truth:
    """Ground truth of a recorded episode of pick-place, of `n` frames."""

    def __init__(self, frames: Mapping[str, np.ndarray]) -> None:
        place, start = frames[ft.TRUTH_OBJECT_POSE][:, :3], frames[ft.TRUTH_START]
        position, turn = np.split(frames[ft.TCP_POSE], [3], axis=1)
        hand = Rotation.from_quat(turn, scalar_first=True)
        # whether a pad touches something
        self.touched: Bool[np.ndarray, " n"] = np.any(frames[ft.TRUTH_CONTACT], axis=1)
        # of the object above its start, and from the goal over the table, m
        self.height: Float[np.ndarray, " n"] = place[:, 2] - start[:, 2]
        self.away: Float[np.ndarray, " n"] = np.linalg.norm(place[:, :2] - start[:, 5:7], axis=1)
        # object in the TCP frame, m
        self.in_hand: Float[np.ndarray, "n 3"] = hand.apply(place - position, inverse=True)
        # force that pushes the hand up, and normal force on each pad, N
        self.pressing: Float[np.ndarray, " n"] = frames[ft.WRENCH][:, 2]
        self.grip: Float[np.ndarray, "n 2"] = -frames[ft.TRUTH_PAD_WRENCH][:, [2, 8]]
        self.success = bool(frames[ft.TRUTH_SUCCESS][-1, 0])  # of the task

    @property
    def held(self) -> bool:
        """Whether both pads press on something at the end."""
        return bool(np.all(self.grip[-1] > 0.1))

    @property
    def carried(self) -> bool:
        """Whether the object was lifted."""
        return bool(self.height.max() > _LIFTED)

    @property
    def grasps(self) -> int:
        """Number of separate times that both pads held something."""
        gripped = np.asarray((self.grip > 0.1).all(axis=1))
        return int(gripped[0]) + int((np.diff(gripped.astype(int)) == 1).sum())

    @property
    def slide(self) -> float:
        """Distance (m) that the object moved in the hand after it was lifted, at the end."""
        lifted = np.flatnonzero(self.height > _LIFTED)
        if not len(lifted):
            return 0.0
        return float(np.linalg.norm(self.in_hand[-1] - self.in_hand[lifted[0]]))


def outcome_reached(outcome: Outcome, frames: Mapping[str, np.ndarray]) -> bool:
    """Return whether an episode ended as its expert was asked to end it."""
    return bool(_CHECKS[outcome](Truth(frames)))


_CHECKS: dict[Outcome, Callable[[Truth], bool | np.bool_]] = {
    "success": lambda t: t.success,
    "slow": lambda t: t.success,
    "regrasped": lambda t: t.success and t.grasps > 1,
    "never_touch": lambda t: not t.touched.any(),
    "never_lifted": lambda t: t.held and not t.carried,
    "freeze": lambda t: not t.touched.any(),
    "freeze_holding": lambda t: t.held and t.height[-1] > _LIFTED,
    "drop": lambda t: t.carried and not t.touched[-1] and not t.success,
    "released_early": lambda t: t.carried and not t.touched[-1] and not t.success,
    "off": lambda t: t.held and t.carried and _TOLERANCE < t.away[-1] < 2 * _TOLERANCE,
    "slip": lambda t: t.held and t.slide > _SLID,
    "edge_grasp": lambda t: t.held and t.success and abs(t.in_hand[-1, 0]) > _OFF_CENTRE,
    # A weak grip gives way: then the hand slides down over the object.
    "pressed": lambda t: t.held and (t.pressing.max() > _PRESSED or t.slide > _SLID),
    "overgripped": lambda t: (
        t.success and _OVERGRIPPED[0] < t.grip[-1].min() and t.grip[-1].max() < _OVERGRIPPED[1]
    ),
    "wrong_object": lambda t: t.held and not t.carried and not t.success,
    "same_shape": lambda t: t.held and t.carried and t.away[-1] < _TOLERANCE and not t.success,
}
