"""Both sides of each figure of the drivers, on the makers' client libraries with a simulated clock."""

import signal
from dataclasses import replace
from multiprocessing.connection import Connection
from types import SimpleNamespace
from unittest.mock import MagicMock, call

import cv2
import numpy as np
import pytest
from both_sides import complaint, sides
from numbered_images import numbered

from touchgoal.control.arms import driver_process, franka, streaming, ur
from touchgoal.control.arms.driver_process import DriverProcess
from touchgoal.control.arms.streaming import ArmClient, ArmConfig, ArmProcess, shift_wrench
from touchgoal.control.cell import connection
from touchgoal.control.cell.cell_file import EXAMPLES, read_cell_file
from touchgoal.control.cell.config import GripperSection
from touchgoal.control.grippers import robotiq
from touchgoal.control.grippers.franka_hand import FrankaHandClient
from touchgoal.control.grippers.hand_commands import HandCommands
from touchgoal.control.grippers.robotiq import Robotiq
from touchgoal.control.interfaces import ArmReading, DriverError, Frame
from touchgoal.control.motion.arm_models import JointLimits
from touchgoal.control.safety.limits import FR3, UR5E
from touchgoal.control.sensors import exchanged, fingertip_source, video
from touchgoal.control.sensors.image_integrity import FrozenParts
from touchgoal.control.sensors.latest_value import LatestValue
from touchgoal.control.sensors.load_cell import LoadCellConfig, Sample, SerialLoadCell, parse
from touchgoal.control.sensors.tactile_camera import NO_CROP, crop_to_sensor
from touchgoal.control.sensors.video import VideoCamera, VideoConfig
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI

Patch = pytest.MonkeyPatch
HOME, E = FR3.arm.home, np.eye(7)
UR_CONFIG = ArmConfig("", UR5E, 125.0, 0.05)


class Wall:
    """Stands for the module `time`: sleeping takes no time, and a look at the clock a little."""

    def __init__(self, look: float = 0.0) -> None:
        self.now, self.look = 0.0, look

    def monotonic(self) -> float:
        self.now += self.look
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def wall(monkeypatch: Patch) -> Wall:
    wall = Wall()
    for module in (streaming, ur, robotiq, video, fingertip_source):
        monkeypatch.setattr(module, "time", wall)
    return wall


class Client(ArmClient):
    """A controller of its own time (s), whose arm moves at some speed (rad/s)."""

    time, speed, sent = 0.0, 0.0, 0

    def _connect(self, recover: bool) -> JointLimits:
        self._commanded = HOME
        return FR3.interface

    def _measure(self) -> ArmReading:
        q = HOME + self.speed * streaming.time.monotonic() * E[0]
        stamp = self._stamped(streaming.time.monotonic() if self.speed else self.time)
        return ArmReading(q, 0 * HOME, np.zeros(6), 0 * HOME, "", stamp, self.time)

    def _send(self, q: np.ndarray, velocity: np.ndarray) -> None: ...
    def _halt(self) -> None: ...
    def _disconnect(self) -> None: ...


@pytest.fixture
def client(wall: Wall) -> Client:
    return Client(ArmConfig("", FR3, 200.0, 0.5), False)


def test_a_late_tick_makes_up_for_four_periods(client: Client) -> None:
    client.command(HOME + 0.01 * E[0])
    client._tracker.step = step = MagicMock(wraps=client._tracker.step)
    for periods, steps in ((3, 3), (4, 4), (9, 4)):
        step.reset_mock()
        client.time += 0.005 * periods
        client.tick()
        assert step.call_count == steps


@pytest.mark.parametrize(
    ("period", "ticks", "lost"), [(0.1, 5, False), (0.102, 5, True), (0.26, 4, False)]
)
def test_half_a_second_without_news_loses_the_arm(
    client: Client, wall: Wall, period: float, ticks: int, lost: bool
) -> None:
    """But not where this process was held up for half of that between two ticks."""
    said = ""
    for _ in range(ticks):
        wall.now += period
        said = said or complaint(client.tick)
    assert ("no state for 500 ms" in said) == lost


@sides((0.0099, 0.0101))
def test_a_closed_arm_is_watched_until_it_rests(
    client: Client, wall: Wall, value: float, beyond: bool
) -> None:
    client.speed = value
    client.close()
    assert wall.now == pytest.approx(1.5 if beyond else 0.05, abs=0.04)


def test_targets_are_taken_inside_the_range_and_until_a_stop(client: Client) -> None:
    for joint in range(7):
        for end, outwards in ((FR3.interface.lower, -E), (FR3.interface.upper, E)):
            q = np.where(E[joint] > 0, end, HOME)
            assert not complaint(client.command, q)
            assert "beyond a joint" in complaint(client.command, q + 1e-6 * outwards[joint])
    client.stop()
    assert "no command is taken" in complaint(client.command, HOME)


def test_each_arm_is_driven_at_its_rate(monkeypatch: Patch) -> None:
    monkeypatch.setattr(streaming, "DriverProcess", made := MagicMock())
    for name, rate, timeout in (("fr3_two_minis", 200.0, 0.5), ("ur5e", 125.0, 0.05)):
        connection.connect_arm(read_cell_file(EXAMPLES / f"{name}.toml"))
        config = made.call_args.args[1]
        assert (config.rate, config.state_timeout) == (rate, timeout)
        assert made.call_args.kwargs == {"call_timeout": 1.5}
    still = replace(read_cell_file(EXAMPLES / "fr3_two_minis.toml"), lock_step=True)
    connection.connect_arm(still)  # nothing moves while a twin in lock-step is late
    assert made.call_args.kwargs["call_timeout"] == 60.0


def use(monkeypatch: Patch, **modules: MagicMock) -> None:
    """Stand in for the makers' client libraries."""
    load = "touchgoal.control.arms.client_libraries.ClientLibrary.load"
    monkeypatch.setattr(load, lambda _, module: modules[module])


def test_what_the_franka_is_told(monkeypatch: Patch) -> None:
    """It stops itself at 30 N and 20 Nm; 99 and 98 % of its limits, of which 90 % are for the stream."""
    use(monkeypatch, franky=(library := MagicMock()))
    library.ControlException, robot = KeyError, library.Robot.return_value
    state, set_ = robot.state, {}
    state.q = state.q_d = state.dq = state.tau_ext_hat_filtered = HOME
    state.O_F_ext_hat_K, state.robot_mode = np.ones(6), library.RobotMode.Idle
    contact = state.O_T_EE.__mul__.return_value
    contact.translation = contact.__mul__.return_value.translation = np.zeros(3)
    state.time.to_sec.return_value = 0.0
    for name in ("velocity", "acceleration", "jerk"):
        limit = getattr(robot, f"joint_{name}_limit")
        limit.max, limit.get = np.full(7, 1e4), lambda n=name: set_[n]
        limit.set = lambda value, n=name: set_.update({n: value})
    client = franka.FrankaClient(ArmConfig("", FR3, 200.0, 0.5), False)
    told = library.Robot.call_args.kwargs
    assert (told["default_torque_threshold"], told["default_force_threshold"]) == (20.0, 30.0)
    assert set_["velocity"] == pytest.approx([2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26])
    assert {*set_["acceleration"], *set_["jerk"]} == {9.9, 4900.0}
    used = client._limits(robot)
    ends = used.velocity[0], used.acceleration[0], used.jerk[0], used.upper[0]
    assert ends == pytest.approx((2.358, 8.91, 4410.0, 2.6437))
    for off, speed in ((0.01, 0.1), (-0.1, -1.0), (1.0, 2.62)):  # tenfold, and no more than it can
        client._send(HOME + off * E[0], 0 * HOME)
        assert library.JointVelocityMotion.call_args.args[0] == pytest.approx(speed * E[0])
    library.Duration.assert_called_with(100)


@pytest.fixture
def rtde(monkeypatch: Patch) -> SimpleNamespace:
    receive, control, dashboard = MagicMock(), MagicMock(), MagicMock()
    for name in (
        "getActualQ",
        "getTargetQ",
        "getActualQd",
        "getActualTCPForce",
        "getActualTCPPose",
    ):
        getattr(receive, name).return_value = [0.0] * 6
    receive.getTimestamp.return_value = 0.0
    control.getForwardKinematics.return_value = [0.0] * 6
    receive.isProtectiveStopped.return_value = receive.isEmergencyStopped.return_value = False
    use(
        monkeypatch,
        rtde_receive=MagicMock(RTDEReceiveInterface=lambda _: receive),
        rtde_control=MagicMock(RTDEControlInterface=lambda _: control),
        dashboard_client=MagicMock(DashboardClient=lambda _: dashboard),
    )
    return SimpleNamespace(receive=receive, control=control, dashboard=dashboard)


@pytest.mark.parametrize(("rate", "lookahead"), [(125.0, 0.03), (20.0, 0.1), (5.0, 0.2)])
def test_what_the_ur_is_told(rtde: SimpleNamespace, rate: float, lookahead: float) -> None:
    client, q = ur.UrClient(ArmConfig("", UR5E, rate, 0.05), False), np.zeros(6)
    rtde.control.setWatchdog.assert_called_with(10.0)
    client._send(q, q)
    expected = pytest.approx([1 / rate, lookahead, 300.0])
    assert rtde.control.servoJ.call_args.args[3:] == expected
    client._halt()
    rtde.control.servoStop.assert_called_with(10.0)


@sides((1.9, 2.1))
def test_a_ur_has_two_seconds_to_unlock(
    rtde: SimpleNamespace, wall: Wall, value: float, beyond: bool
) -> None:
    rtde.receive.isProtectiveStopped = lambda: wall.now < value
    assert ("protective stop" in complaint(ur.UrClient, UR_CONFIG, True)) == beyond
    rtde.dashboard.connect.assert_called_with(2000)
    assert not rtde.control.zeroFtSensor.called, "what still presses must stay visible"


@sides((0.09, 0.12))
def test_a_ur_has_a_tenth_of_a_second_to_report_its_stop(
    rtde: SimpleNamespace, wall: Wall, value: float, beyond: bool
) -> None:
    client = ur.UrClient(UR_CONFIG, False)
    assert rtde.control.zeroFtSensor.called and rtde.control.kickWatchdog.called
    rtde.control.isProgramRunning.return_value = False
    rtde.receive.isProtectiveStopped = lambda: wall.now > value
    assert ("protective stop" in client._measure().fault) != beyond


def test_how_long_a_driver_process_is_waited_for(monkeypatch: Patch) -> None:
    """And when the kernel ends it: a second after that, or 3 s after a tick that does not return."""
    pipe, theirs, alarms = MagicMock(spec=Connection), MagicMock(), []
    pipe.recv.return_value = None, None
    monkeypatch.setattr(driver_process, "Pipe", lambda: (pipe, theirs))
    monkeypatch.setattr(driver_process.subprocess, "Popen", popen := MagicMock())
    monkeypatch.setattr(signal, "setitimer", lambda _, seconds: alarms.append(seconds))
    popen.return_value.poll.return_value = None
    child = DriverProcess(Client)
    child.call("read")
    assert pipe.poll.call_args_list == [call(30.0), call(1.5)]
    child.close()
    popen.return_value.wait.assert_called_with(4.0)
    driver = MagicMock(spec=Client, period=0.005)
    pipe.recv.return_value = "tick", (), 1.5
    driver_process._answer(driver, pipe)
    pipe.poll.side_effect = EOFError
    with pytest.raises(EOFError):
        driver_process._serve(driver, pipe)
    assert alarms == [2.5, pytest.approx(3.005)]


def test_what_the_franka_hand_is_told(monkeypatch: Patch) -> None:
    """0.1 m/s and 30 N; half a second for a stop, one for an answer that a twin has sent."""
    use(monkeypatch, franky=(library := MagicMock()))
    hand, times = library.Gripper.return_value, iter(range(99))
    hand.state.width = hand.state.max_width = 0.08
    hand.state.is_grasped, hand.state.time.to_msec = False, lambda: next(times)
    client = FrankaHandClient("here", 30.0)
    client.command(0.0)
    client.tick()
    assert hand.grasp_async.call_args.args == (0.0, 0.1, 30.0) and client.period == 0.05
    moving = hand.grasp_async.return_value.wait
    moving.return_value = False
    for answered, seconds in ((0, 0.0), (1, 1.0)):
        client.advance(answered)
        moving.assert_called_with(seconds)
    client.stop(0.06)
    hand.stop_async.return_value.wait.assert_called_with(0.5)
    hand.move_async.assert_called_with(0.06, 0.1)


def test_when_and_how_a_hand_is_commanded() -> None:
    """Changes of more than 2 mm; one that goes on by more than 5 mm a look waits for three looks."""
    for start, *targets, sent in (
        (0.0, 0.0021, True), (0.0, 0.0019, False), (0.04, 0.0449, True), (0.04, 0.0451, False),
        (0.04, 0.046, 0.052, 0.058, False), (0.04, 0.046, 0.052, 0.058, 0.064, True),
    ):  # fmt: skip
        hand = HandCommands(start)
        commands = [hand.next(target, start, False, "arrived") for target in targets]
        assert [bool(command) for command in commands] == [False] * (len(targets) - 1) + [sent]
    for target, grasp in ((0.0021, False), (0.0019, True)):
        hand = HandCommands(0.04)
        commands = [hand.next(target, 0.04, False, "arrived") for _ in range(2)]
        assert [command.grasp for command in commands if command] == [grasp]


@sides((7.9, 8.2))
def test_a_robotiq_has_eight_seconds_to_activate(wall: Wall, value: float, beyond: bool) -> None:
    gripper = Robotiq.__new__(Robotiq)
    gripper.config = GripperSection("robotiq", activate=True)
    gripper._write = lambda command: None
    gripper._status = lambda: bytes([0x31 if wall.now > value else 0x11])
    assert ("does not become active" in complaint(gripper._start)) == beyond


def test_a_first_reading_is_waited_for_five_seconds(monkeypatch: Patch) -> None:
    value = LatestValue("a device", lambda: None)
    monkeypatch.setattr(value._updated, "wait", waited := MagicMock())
    assert "gives nothing" in complaint(value.read)
    waited.assert_called_with(5.0)
    value.close()


def test_how_old_a_image_may_be(wall: Wall, monkeypatch: Patch) -> None:
    """Late after three periods, frozen after half a second; a stream opens in 5 s, then in one."""
    jpeg = cv2.imencode(".jpg", numbered(1))[1].reshape(1, -1)
    capture, opened = MagicMock(), MagicMock()
    opened.return_value = capture
    capture.read.return_value = capture.retrieve.return_value = True, jpeg
    monkeypatch.setattr(cv2, "VideoCapture", opened)
    monkeypatch.setattr(video, "LatestValue", latest := MagicMock())
    camera = VideoCamera(VideoConfig("http://here", rate=50.0))
    latest.return_value.read.return_value = camera._take()

    def stamp(camera: VideoCamera, now: float) -> float:
        wall.now = now
        assert (frame := camera._take())
        return frame.stamp

    for age, late in ((0.059, False), (0.061, True)):
        wall.now = age
        assert bool(camera.problem) == late
    assert [stamp(camera, now) for now in (0.49, 0.51)] == [0.49, 0.0]
    patient = VideoCamera(VideoConfig("http://twin", frozen_after=0.0, frozen_images=2))
    stamps = [stamp(patient, now) for now in (0.51, 0.61, 0.71, 0.81)]
    assert stamps == [0.51, 0.61, 0.71, 0.51], "the third unchanged image is old"
    patient.close()
    capture.grab.return_value = False
    camera._take()
    ways = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, cv2.CAP_PROP_READ_TIMEOUT_MSEC]
    limits = [dict(zip(c.args[2][::2], c.args[2][1::2], strict=True)) for c in opened.mock_calls
              if c.args[:1] == ("http://here",)]  # fmt: skip
    assert limits == [dict(zip(ways, ms, strict=True)) for ms in ((5000, 1000), (1000, 1000))]
    assert wall.now == pytest.approx(1.31)
    camera.close()


def test_a_fingertip_is_lost_after_five_seconds(wall: Wall, monkeypatch: Patch) -> None:
    monkeypatch.setattr(fingertip_source, "VideoCamera", MagicMock())
    monkeypatch.setattr(fingertip_source.tactile_camera, "TactileCamera", made := MagicMock())
    made.return_value.read.return_value = Frame(np.zeros((240, 320, 3), np.uint8), 0, 0.0)
    assert complaint(list, fingertip_source.open_frames("http://here", GELSIGHT_MINI))
    assert wall.now == pytest.approx(5.0, abs=0.011)


@sides((256, 257))
def test_a_load_cells_line_has_256_bytes_and_200_newtons(value: int, beyond: bool) -> None:
    cell = SerialLoadCell.__new__(SerialLoadCell)
    cell._buffer, cell._at_line_start, cell._rejected = b"", True, 0
    cell._port = MagicMock(read=lambda _: b"x" * value, in_waiting=0)
    cell._take()
    assert cell._rejected == beyond
    config = LoadCellConfig("", 1.0, 0.0, checksum="none")
    assert parse(b"1,-200", config) == Sample(-200.0, 1.0) and parse(b"1,-200.1", config) is None


def test_when_cameras_and_fingertips_look_exchanged(monkeypatch: Patch) -> None:
    first, second = (np.full((1, 1, 3), n, np.uint8) for n in (0, 1))
    for front, wrist, found in ((2.49, 0, 0), (2.51, 0, 1), (6.0, 2.01, 0), (6.0, 1.99, 1)):
        monkeypatch.setattr(exchanged, "_median_change", MagicMock(side_effect=[front, wrist]))
        assert exchanged.cameras_exchanged((first, first), (first, first)) == found
    for unlike, found in ((1.49, 0), (1.51, 1)):
        change = lambda a, b, u=unlike: np.full(1, u if (a == b).all() else 1.0)  # noqa: E731
        monkeypatch.setattr(exchanged, "local_change", change)
        assert exchanged.fingertips_exchanged((first, second), (first, second)) == found


@sides((15, 16))
def test_a_band_that_changed_in_16_of_20_images_is_watched(value: int, beyond: bool) -> None:
    parts, since = FrozenParts(), []
    for k in range(21):
        image = np.full((80, 8, 3), k, np.uint8)
        image[:10] = min(k, value)
        since.append(parts.update(image, float(k)))
    assert since == [*range(20), value if beyond else 20]


@sides((311, 310), (329, 330))
def test_a_fingertips_proportions_are_right_within_3_percent(value: int, beyond: bool) -> None:
    image = np.zeros((240, value, 3), np.uint8)
    assert bool(complaint(crop_to_sensor, image, GELSIGHT_MINI, NO_CROP)) == beyond


@pytest.mark.parametrize("client", [franka.FrankaClient, ur.UrClient])
def test_no_controller_is_said(client: type) -> None:
    robot = FR3 if client is franka.FrankaClient else UR5E
    with pytest.raises(DriverError, match="FCI|verify the IP"):
        ArmProcess(client, ArmConfig("127.99.99.99", robot, 100.0, 0.5))


def test_a_wrench_is_moved_with_its_lever() -> None:
    down = np.array([0, 0, -10.0, 0, 0, 0])
    moved = shift_wrench(down, np.array([0.1, 0, 0]), np.zeros(3))
    np.testing.assert_allclose(moved, [0, 0, -10, 0, 1, 0])
