"""Universal Robots e-Series (UR5e) through ur-rtde, in a child process.

ur-rtde reports success on a dead link, and later reconnects by itself and crashes (measured). So 50 ms
without progress of the controller's clock end the process, and only a person's `recover` starts a new
one. The controller's own watchdog stops the arm if this process dies.
"""

import time

import numpy as np

from touchgoal.control.arms.client_libraries import UR_RTDE
from touchgoal.control.arms.streaming import ArmClient, shift_wrench
from touchgoal.control.interfaces import ArmReading, DriverError, Joints
from touchgoal.control.motion.arm_models import JointLimits
from touchgoal.control.motion.rotations import rotation_matrix

RATE = 125.0  # Hz of servoJ; 20 to 500
STATE_TIMEOUT = 0.05  # s
_GAIN = 300.0  # servoJ's gain, 100 to 2000; URScript's default
_LOOKAHEAD = 0.03, 0.2  # s, servoJ's range; the arm lags by about this much
_BRAKING = 10.0  # rad/s^2 of servoStop; ur-rtde's default
_UNLOCKING = 2.0  # s that clearing a protective stop may take
_STOP_REPORTED = 0.1  # s after the control program's end in which a stop is reported
_WATCHDOG = 10.0  # Hz; with fewer commands the controller stops its program, and so the arm


class UrClient(ArmClient):
    """One UR in remote control, in the driver's process."""

    def _connect(self, recover: bool) -> JointLimits:
        robot = self.config.robot
        self._kinematics = robot.kinematics()
        self._refused, self._ended = False, ""
        self._receive = UR_RTDE.load("rtde_receive").RTDEReceiveInterface(self.config.address)
        if recover and self._receive.isProtectiveStopped():
            self._unlock()
        if self._stopped():
            raise DriverError(self._stopped())
        self._control = UR_RTDE.load("rtde_control").RTDEControlInterface(self.config.address)
        self._control.setPayload(robot.tool.mass, list(robot.tool.centre_of_mass))
        if not recover:  # a force that remains after a stop must stay visible
            self._control.zeroFtSensor()
        # Our tool centre point in the frame of the one that is set at the pendant, whichever that is.
        q, own = self._receive.getActualQ(), np.array(self._receive.getActualTCPPose())
        tool = [0.0, 0.0, robot.tool.tcp_offset, 0.0, 0.0, 0.0]
        ours = np.array(self._control.getForwardKinematics(q, tool)[:3])  # as calibrated
        self._point = rotation_matrix(own[3:]).T @ (ours - own[:3])
        self._control.setWatchdog(_WATCHDOG)
        self._lookahead = float(np.clip(2 * self.period, *_LOOKAHEAD))
        return self.config.robot.interface

    def _unlock(self) -> None:
        """Unlock as at the pendant; the controller refuses for the first 5 s."""
        dashboard = UR_RTDE.load("dashboard_client").DashboardClient(self.config.address)
        dashboard.connect(int(1e3 * _UNLOCKING))
        dashboard.closeSafetyPopup()
        dashboard.unlockProtectiveStop()
        end = time.monotonic() + _UNLOCKING
        while self._receive.isProtectiveStopped() and time.monotonic() < end:
            time.sleep(0.05)
        dashboard.disconnect()

    def _measure(self) -> ArmReading:
        receive = self._receive
        if not (receive.isConnected() and self._control.isConnected()):
            raise DriverError("the controller closed the connection")
        clock, q = receive.getTimestamp(), np.array(receive.getActualQ())
        self._commanded = np.array(receive.getTargetQ())
        tcp, _ = self._kinematics.forward(q)
        # Forces "acting on the end point of the TCP" (UR about get_tcp_force), about the controller's
        # own TCP, in its base frame, without the payload's weight.
        wrench, own = np.array(receive.getActualTCPForce()), np.array(receive.getActualTCPPose())
        wrench = shift_wrench(wrench, own[:3], tcp)
        reading = ArmReading(
            q=q,
            velocity=np.array(receive.getActualQd()),
            wrench=wrench,
            torque=self._kinematics.jacobian(q).T @ wrench,  # the arm does not measure it
            fault=self._fault(),
            stamp=self._stamped(clock),
            time=clock,
            tcp=own[:3] + rotation_matrix(own[3:]) @ self._point,
        )
        if self._state is None and not reading.fault:
            self._control.kickWatchdog()
        return reading

    def _stopped(self) -> str:
        if self._receive.isEmergencyStopped():
            return "emergency stop: release it and restart the arm at the pendant, then recover"
        if self._receive.isProtectiveStopped():
            return "protective stop: clear the cause, wait 5 s, then: touchgoal arm recover"
        return ""

    def _fault(self) -> str:
        if stopped := self._stopped():
            return stopped
        if self._refused or not self._control.isProgramRunning():
            self._ended = self._ended or self._why_ended()
        return self._ended

    def _why_ended(self) -> str:
        """Say why the control program ended; a stop is reported some packets later."""
        end = time.monotonic() + _STOP_REPORTED
        while not self._stopped() and time.monotonic() < end:
            time.sleep(self.period)
        return (
            self._stopped()
            or "the control program ended: look at the pendant's log, then recover the arm"
        )

    def _send(self, q: Joints, velocity: Joints) -> None:
        taken = self._control.servoJ(q.tolist(), 0.0, 0.0, self.period, self._lookahead, _GAIN)
        self._refused = not taken  # the next measurement says why

    def _halt(self) -> None:
        self._control.servoStop(_BRAKING)

    def _disconnect(self) -> None:
        self._control.stopScript()
        self._control.disconnect()
        self._receive.disconnect()
