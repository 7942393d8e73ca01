"""A client's motion, from its Move command to the answer that ends it."""

from dataclasses import dataclass

from touchgoal.sim_envs.twin.franka import messages


@dataclass
class Motion:
    """A motion in progress.

    Attributes:
        request: the Move command, answered when the motion ends.
        generator, controller: numbers of the interface.
        begun: whether the client has sent a set-point.
        lost: milliseconds since the last one.
    """

    request: messages.Request
    generator: int
    controller: int
    begun: bool = False
    lost: int = 0
