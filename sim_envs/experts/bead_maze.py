"""The bead maze's demonstrator; it knows the wire and returns to it after a disturbance."""

import numpy as np

from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor
from touchgoal.control.motion.rotations import fingers_across, rotation_matrix, rotation_vector
from touchgoal.sim_envs.bead_maze import BeadMaze

_SPEED = 0.025  # m/s along the wire
_RETURN = 5.8  # 1/s: decay of a deviation from the course, a quarter of it per tick at 20 Hz
_FASTEST = 0.02  # m/s (or, times _LEVER, rad/s): fastest return from a large deviation
_LEAD = 0.006  # m that the commanded bead may be ahead of the real one, which may be jammed
_SLOW = 0.004  # m (or, times _LEVER, rad) of deviation at which motion along the wire stops
_LEVER = 0.02  # m by which a turn counts as a displacement: the size of the bead
_AT_POST = 0.388  # m of arc; the post stops the bead 1 to 4 mm further on
_PRESS = 0.0015  # m that the commanded bead is ahead there when the hand stops: about 7 N
_PRESSED_SECONDS = 0.7  # s at the post after which it is done


class BeadMazeExpert(Actor):
    """Leads the bead along the wire to its post, the hand turned with the wire.

    It acts on the commanded pose, so that the arm's compliance does not add up; a bead that slipped
    in the hand is led from where it is.
    """

    def __init__(self, env: BeadMaze) -> None:
        self._env, self._ticks_at_post = env, 0

    def act(self, observation: Observation) -> np.ndarray:
        """Return the action for the next tick; the observation is not used."""
        env = self._env
        self._ticks_at_post += env.arc_length > _AT_POST
        self.done = self._ticks_at_post > _PRESSED_SECONDS * env.config.control_hz
        tick, grip = 1 / env.config.control_hz, self._grip()
        position, R = env.kinematics.forward(env.command)
        bead = position + R @ grip
        s = env.wire.project(bead, env.arc_length)
        pressed = env.arc_length > _AT_POST and s > env.arc_length + _PRESS
        if env.grasping or pressed:
            return np.zeros(env.n_joints + 1)
        point, tangent = env.wire.at(s)
        off = bead - point
        turned = rotation_vector(fingers_across(tangent).T @ R)
        deviation = max(float(np.linalg.norm(off)), _LEVER * float(np.linalg.norm(turned)))
        ahead = _SPEED * tick * max(0.0, 1 - deviation / _SLOW)
        left = max(np.exp(-_RETURN * tick), 1 - _FASTEST * tick / max(deviation, 1e-9))
        point, tangent = env.wire.at(min(s + ahead, env.arc_length + _LEAD))
        R = fingers_across(tangent) @ rotation_matrix(left * turned)
        target = point + left * off - R @ grip
        joints = env.kinematics.solve_ik_near(target, R, env.command).q
        return np.append(joints - env.command, 0.0)

    def _grip(self) -> np.ndarray:
        """Return where the bead would sit in the TCP frame if the gels were not deflected, m."""
        data = self._env.data
        sides = ("left", "right")
        gels = [data.body(f"{s}_gel").xpos - data.site(f"{s}_sensor").xpos for s in sides]
        tcp = data.site("tcp")
        offset = self._env.object_pose()[:3] - tcp.xpos - 0.5 * (gels[0] + gels[1])
        return tcp.xmat.reshape(3, 3).T @ offset
