"""Delays of an arm that `deploy` drives, as options of the environment."""

from typing import Annotated

from pydantic import Field

from touchgoal.runtime.option_types import FIXED, ORDERED, checked_dataclass

Delay = Annotated[float, Field(ge=0.0, le=0.2)]
"""s"""
DelayRange = Annotated[tuple[Delay, Delay], ORDERED]
TickRange = Annotated[tuple[Annotated[int, Field(ge=0, le=2)], ...], Field(min_length=1)]


@checked_dataclass
class DeploymentConfig:
    """Delays of a real arm, drawn for each episode.

    The defaults were measured between `touchgoal deploy` and `touchgoal twin` (`python -m benchmarks
    deploy`): states are 7 to 18 ms old; commands take 20 to 25 ms with the tracker's lag; plans come a
    tick late. Cameras and fingertips: 25 to 30 frames a second (GelSight Mini and DIGIT data sheets).
    """

    state_delay: DelayRange = (0.005, 0.02)
    """Least and largest age of joint positions, velocities and force in an observation, s."""
    image_delay: DelayRange = (0.005, 0.02)
    """Least and largest age of camera and tactile images in an observation, s."""
    image_rate: Annotated[float, Field(ge=5, le=1000), FIXED] = 30.0
    """Frame rate of cameras and fingertip sensors, Hz. An observation holds the latest frame."""
    command_delay: DelayRange = (0.005, 0.02)
    """Least and largest time from the policy's action until arm and hand receive it, s."""
    jitter: DelayRange = (0.0, 0.02)
    """Range of an episode's jitter, s. Each tick adds a random part of it to each delay."""
    plan_ticks: TickRange = (1,)
    """Control ticks by which a learned policy's plans are late; one of these is drawn."""
