"""Options of teleoperation; light to import for `touchgoal --help`."""

from typing import Annotated

from pydantic import Field

from touchgoal.runtime.option_types import checked_dataclass

# Speed per force and turning speed per torque at which the hand yields, m/s per N beyond 3 N and rad/s
# per Nm beyond 0.3 Nm; much more oscillates.
COMPLIANCE = 2e-3, 0.5


@checked_dataclass
class TeleoperationConfig:
    """Response of the hand to a device."""

    speed: Annotated[float, Field(gt=0, le=0.5)] = 0.1
    """Speed of the hand at full deflection, m/s; with a keyboard, at any key."""
    turn_speed: Annotated[float, Field(gt=0, le=2)] = 0.6
    """Turning speed of the hand at full deflection, rad/s."""
