"""Demonstrations that begin with a pause, which a policy imitates by not starting."""

import numpy as np

from touchgoal.control.features import ACTION, STATE
from touchgoal.episodes.schema import Episode

_JOINT_MOTION = 2e-3  # rad since the first frame, or commanded since then
_WIDTH_MOTION = 5e-4  # m of gripper width, measured or commanded


def leading_pause(episode: Episode) -> int:
    """Return how many frames pass before an episode's arm or gripper moves or is commanded to.

    An episode without motion has no start to trim to: 0. Needs `STATE` and `ACTION`.
    """
    state, action = episode.frames[STATE], episode.frames[ACTION]
    joints = action.shape[1] - 1
    commanded = np.abs(np.cumsum(action[:, :joints], axis=0)).max(1) > _JOINT_MOTION
    commanded |= np.abs(action[:, -1] - action[0, -1]) > _WIDTH_MOTION
    moved = np.abs(state[:, :joints] - state[0, :joints]).max(1) > _JOINT_MOTION
    moved |= np.abs(state[:, -1] - state[0, -1]) > _WIDTH_MOTION
    moving = np.flatnonzero(commanded | moved)
    return int(moving[0]) if len(moving) else 0
