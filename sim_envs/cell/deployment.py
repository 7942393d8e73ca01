"""Delays and dynamics of an arm that `deploy` drives, as options of the environment."""

from typing import Annotated

from pydantic import Field

from touchgoal.runtime.option_types import FIXED, ORDERED, checked_dataclass

Delay = Annotated[float, Field(ge=0.0, le=0.2)]
"""s"""
DelayRange = Annotated[tuple[Delay, Delay], ORDERED]
TickRange = Annotated[tuple[Annotated[int, Field(ge=0, le=2)], ...], Field(min_length=1)]


@checked_dataclass
class DeploymentConfig:
    """Delays and dynamics of a real arm, drawn for each episode.

    Options not given follow `--env.as-deployed`: with it they are as over the wire, without it off.
    """

    tracker: Annotated[bool | None, FIXED] = None
    """Drive the arm as `deploy` does: servo lag, the safety layer's limits, the 1 kHz tracker, and
    an arm that follows its set-points without lag."""
    franka_hand: Annotated[bool | None, FIXED] = None
    """Act as a Franka Hand: one command at a time, each runs to its end; a target of 0 grasps, any
    other width is a move. The width is read every 50 ms."""
    estimated_wrench: Annotated[bool | None, FIXED] = None
    """Observe the force on the hand as a real arm estimates it: with noise, bias, drift and lag."""
    state_delay: DelayRange | None = None
    """Least and largest age of joint positions, velocities and force in an observation, s."""
    image_delay: DelayRange | None = None
    """Least and largest age of camera and tactile images in an observation, s."""
    image_rate: Annotated[float | None, Field(ge=5, le=1000), FIXED] = None
    """Frame rate of cameras and fingertip sensors, Hz. An observation holds the latest frame; as
    deployed 30 Hz, else one frame per millisecond."""
    command_delay: DelayRange | None = None
    """Least and largest time from the policy's action until arm and hand receive it, s."""
    jitter: DelayRange | None = None
    """Range of an episode's jitter, s. Each tick adds a random part of it to each delay."""
    plan_ticks: TickRange | None = None
    """Control ticks by which a learned policy's plans are late; one of these is drawn."""


IDEAL_DEPLOYMENT = DeploymentConfig(
    tracker=False,
    franka_hand=False,
    estimated_wrench=False,
    state_delay=(0.0, 0.0),
    image_delay=(0.0, 0.0),
    image_rate=1000.0,
    command_delay=(0.0, 0.0),
    jitter=(0.0, 0.0),
    plan_ticks=(0,),
)
# Measured between `touchgoal deploy` and `touchgoal twin` (`python -m benchmarks deploy`): states
# are 7 to 18 ms old; commands take 20 to 25 ms with the tracker's lag; plans come a tick late.
# Cameras and fingertips: 25 to 30 frames a second (GelSight Mini and DIGIT data sheets).
AS_DEPLOYED = DeploymentConfig(
    tracker=True,
    franka_hand=True,
    estimated_wrench=True,
    state_delay=(0.005, 0.02),
    image_delay=(0.005, 0.02),
    image_rate=30.0,
    command_delay=(0.005, 0.02),
    jitter=(0.0, 0.02),
    plan_ticks=(1,),
)
