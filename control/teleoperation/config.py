"""Options of teleoperation; light to import for `touchgoal --help`."""

from typing import Annotated

from pydantic import Field

from touchgoal.runtime.option_types import NotNegative, checked_dataclass


@checked_dataclass
class TeleoperationConfig:
    """Response of the hand to a device."""

    speed: Annotated[float, Field(gt=0, le=0.5)] = 0.1
    """Speed of the hand at full deflection, m/s; with a keyboard, at any key."""
    turn_speed: Annotated[float, Field(gt=0, le=2)] = 0.6
    """Turning speed of the hand at full deflection, rad/s."""
    compliance: Annotated[NotNegative, Field(le=0.01)] = 2e-3
    """Speed per force at which the hand yields beyond 3 N, m/s per N; much more oscillates."""
    rotational_compliance: Annotated[NotNegative, Field(le=5)] = 0.5
    """Turning speed per torque at which it yields beyond 0.3 Nm, rad/s per Nm."""
