"""What the twin's controller refuses is what the FR3's limits say."""

import numpy as np
import pytest

from touchgoal.control.safety.limits import FR3
from touchgoal.sim_envs.twin.franka.limits import Setpoint, joint_fault


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("end", [0, 1])
def test_speeds_are_refused_above_the_range_of_their_place(joint: int, end: int) -> None:
    limits, zero = FR3.hardware, np.zeros(7)
    for share in np.linspace(0.02, 0.98, 25):  # near the ends of the range less is allowed
        q = FR3.arm.home.copy()
        q[joint] = limits.lower[joint] + share * (limits.upper - limits.lower)[joint]
        speed = limits.speed_range(q)[end][joint]
        for factor, fault in ((1.005, None), (1.02, "velocity_limits_violation")):
            dq = zero.copy()
            dq[joint] = factor * speed + (2e-3 * np.sign(speed) if fault else 0.0)
            found = joint_fault(Setpoint(q, dq, zero), Setpoint(q, dq, zero), cartesian=False)
            if abs(speed) > 0.01:
                assert found == (fault and f"joint_motion_generator_{fault}"), (share, factor)
