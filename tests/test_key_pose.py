"""The next key pose: its labels, its frames, places never recorded, and when the gripper may change."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.spatial.transform import Rotation

from touchgoal.control import features as ft
from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.policies.network import ObservationBatch, PolicyConfig, PolicyNetwork
from touchgoal.policies.sight.average import KeyPoseAverage
from touchgoal.policies.sight.estimates import FIXED, GROUPS, estimate_from, likeliest, to_frame
from touchgoal.policies.sight.frozen_images import ImageInputConfig
from touchgoal.policies.sight.key_pose import face_any_way, key_poses, set_beside, true_pose
from touchgoal.policies.sight.readout import CameraReadout, KeyPoseReadout, errors
from touchgoal.policies.training.end import read_by_end


@pytest.mark.parametrize(
    ("widths", "lengths", "hold", "keys", "following", "closed", "left"),
    [
        (
            [0.08, 0.08, 0.0, 0.0, 0.0, 0.08, 0.08],
            [7],
            0,
            [1, 1, 4, 4, 4, 4, 4],
            [4] * 7,
            "1100000",
            [None, None, 1, 1, 1, 4, 4],
        ),
        (
            [0.08, 0.0, 0.0, 0.08, 0.0, 0.0],
            [3, 3],
            0,
            [0, 2, 2, 3, 5, 5],
            [2, 2, 2, 5, 5, 5],
            "111111",
            [None, 0, 0, None, 3, 3],
        ),
        (
            [0.08, 0.0, 0.0, 0.0, 0.0, 0.08],
            [4, 2],
            2,
            [0, 0, 0, 3, 4, 4],
            [3, 3, 3, 3, 4, 4],
            "111100",
            [None, None, None, 0, None, None],
        ),
        # noise on one width
        ([0.05, 0.0501, 0.05, 0.0502], [2, 2], 0, [1, 1, 3, 3], [1, 1, 3, 3], "0000", [None] * 4),
    ],
)
def test_a_key_pose_is_where_the_gripper_changes_or_the_episode_ends(
    widths: list[float],
    lengths: Sequence[int],
    hold: int,
    keys: list[int],
    following: list[int],
    closed: str,
    left: list[int | None],
) -> None:
    tcp = np.random.default_rng(0).normal(size=(len(widths), 7)).astype(np.float32)
    poses = key_poses(tcp, np.array(widths, np.float32), lengths, hold)
    before, found, then = poses.swapaxes(0, 1)
    assert before[:, 7].astype(bool).tolist() == [n is not None for n in left]
    own = [tick if n is None else n for tick, n in enumerate(left)]
    np.testing.assert_array_equal(before[:, :7], tcp[own])
    np.testing.assert_array_equal(found[:, :7], tcp[keys])
    assert "".join(f"{after:.0f}" for after in found[:, 7]) == closed
    np.testing.assert_array_equal(then[:, :7], tcp[following])


def _poses(rng: np.random.Generator, n: int) -> torch.Tensor:
    """Random hand poses over a table, fingers down and turned by up to 0.8 rad."""
    turn = Rotation.from_euler("z", rng.uniform(-0.8, 0.8, (n, 1)))
    quaternion = (turn * Rotation.from_quat([1, 0, 0, 0])).as_quat(scalar_first=True)
    place = rng.uniform([0.4, -0.2, 0.1], [0.6, 0.2, 0.3], (n, 3))
    return torch.from_numpy(np.concatenate([place, quaternion], 1)).float()


def _maps(where: np.ndarray) -> torch.Tensor:
    """Feature maps of one camera, in which a blob stands where it says, in cells."""
    y, x = np.meshgrid(np.arange(12), np.arange(12), indexing="ij")
    blob = np.exp(-((x - where[:, 0, None, None]) ** 2 + (y - where[:, 1, None, None]) ** 2) / 2)
    rng = np.random.default_rng(1)
    maps = rng.normal(0, 0.1, (len(where), 40, 12, 12))
    maps[:, 7] += blob
    return torch.from_numpy(maps).half()


@pytest.mark.parametrize("camera", [ft.FRONT, ft.WRIST])
def test_a_camera_finds_a_thing_at_places_never_seen(camera: str) -> None:
    rng, n = np.random.default_rng(0), 640
    tcp, key, width = _poses(rng, n), _poses(rng, n), torch.full((n, 1), 0.08)
    key[:, 2] = 0.02
    R = Rotation.from_quat(tcp[:, 3:].numpy(), scalar_first=True)
    key = torch.cat([key, (key[:, 1:2] > 0).float()], 1)  # the gripper closes on the left side
    key = torch.stack([key, key + torch.eye(8)[2] / 10], 1)  # and the hand goes up by 10 cm
    seen = key[:, 0, :2].numpy() - [0.5, 0.0]
    if camera == ft.WRIST:
        seen = R.inv().apply((key[:, 0, :7] - tcp)[:, :3].numpy())[:, :2] / 2
    maps = _maps(seen / 0.2 * 4 + 5.5)[:, None]
    torch.manual_seed(0)
    readout = KeyPoseReadout(ImageInputConfig((camera,), (96, 96)))
    hand = torch.cat([tcp, width], 1)
    readout.fit(maps[:512], hand[:512], key[:512])
    optimizer = torch.optim.AdamW(readout.parameters(), 3e-3)
    for step in range(200):
        rows = torch.from_numpy(np.random.default_rng(step).choice(512, 64, replace=False))
        optimizer.zero_grad()
        loss = readout.loss(maps[rows].float(), hand[rows], key[rows])
        loss.backward()
        optimizer.step()
    others = maps[512:].float(), hand[512:]
    off = readout.error(*others, key[512:])
    assert (off.median(0).values < 0.025).all()  # where guessing the mean place is 0.1 m off
    closes = readout(*others)[0][:, 0, 10] > 0.5
    if camera == ft.FRONT:  # the hand's camera does not know where the left side is
        assert (closes == key[512:, 0, 7].bool()).float().mean() > 0.9
    readout.calibration += 1.0
    readout.calibrate(*others, key[512:])
    estimates, expected, _ = readout.estimates(*others)
    made = errors(estimates, readout._true(tcp[512:], key[512:]))
    wanted = torch.ones(1, 2, len(GROUPS))
    torch.testing.assert_close((made / expected.exp()).mean(0), wanted, atol=1e-3, rtol=0)


def _turned_on(poses: torch.Tensor, half_turns: float) -> torch.Tensor:
    turn = Rotation.from_rotvec([0, 0, np.pi * half_turns])
    R = Rotation.from_quat(poses[:, 3:].numpy(), scalar_first=True) * turn
    turned = torch.from_numpy(R.as_quat(scalar_first=True)).float()
    return torch.cat([poses[:, :3], turned], 1)


def test_estimates_turn_into_the_hands_frame_as_scipy_turns_them() -> None:
    rng = np.random.default_rng(2)
    tcp, key = _poses(rng, 20), _poses(rng, 20)
    tilt = Rotation.from_rotvec(rng.normal(0, 0.3, (20, 3)))
    R = tilt * Rotation.from_quat(key[:, 3:].numpy(), scalar_first=True)
    key[:, 3:] = torch.from_numpy(R.as_quat(scalar_first=True))
    hand = Rotation.from_quat(tcp[:, 3:].numpy(), scalar_first=True)
    turned = (hand.inv() * R).as_matrix()
    estimate = estimate_from(tcp, key)
    found = likeliest(estimate)
    place = hand.inv().apply((key - tcp)[:, :3].numpy())
    np.testing.assert_allclose(found[:, :3], place, atol=1e-5)
    # the turn itself, or half a turn on
    near = np.sign((found.numpy()[:, 3:6] * turned[:, :, 0]).sum(1, keepdims=True))
    np.testing.assert_allclose(near * found.numpy()[:, 3:6], turned[:, :, 0], atol=0.02)  # a degree
    np.testing.assert_allclose(near * found.numpy()[:, 6:], turned[:, :, 1], atol=0.02)
    np.testing.assert_allclose(estimate[:, 3:6], turned[:, :, 2], atol=1e-5)
    torch.testing.assert_close(estimate_from(tcp, _turned_on(key, 1)), estimate)
    fixed = torch.tensor([FIXED]).expand(20, 7)
    there = to_frame(fixed, estimate, tcp)
    torch.testing.assert_close(there, estimate_from(fixed, key))
    torch.testing.assert_close(to_frame(tcp, there, fixed), estimate)


@pytest.mark.parametrize("first", [0.5, 0.51])
def test_between_two_ways_to_grasp_a_box_the_mean_is_one_of_them(first: float) -> None:
    rng = np.random.default_rng(4)
    tcp, key = _poses(rng, 20), _poses(rng, 20)
    ways = [estimate_from(tcp, way) for way in (key, _turned_on(key, 0.5))]
    found = likeliest(first * ways[0] + (1 - first) * ways[1])
    alike = [(likeliest(way)[:, 3:] - found[:, 3:]).norm(dim=1) < 0.1 for way in ways]
    assert (alike[0] | alike[1]).all()
    turn = torch.atan2(found[:, 4], found[:, 3]).abs()
    if first == 0.5:
        assert (turn < np.pi / 4 + 0.1).all()  # the nearer one


def test_the_average_of_a_moving_hand_steadies_and_follows_the_gripper() -> None:
    rng, average = np.random.default_rng(3), KeyPoseAverage(0.3)
    tcp, keys = _poses(rng, 60), F.pad(_poses(rng, 3), (0, 1), value=1.0)
    off = []
    for tick, hand in enumerate(tcp[:, None]):
        if tick == 30:
            average.change_gripper()
        stage = int(tick >= 32)  # for half a second the fingers move
        assert average.gripper_moves == (tick in (30, 31))
        true = torch.cat([estimate_from(hand, key[None, :7]) for key in keys[stage : stage + 2]])
        true = F.pad(true, (0, 1), value=1.0)[None]
        hidden = tick % 3 == 2  # and the estimate says so
        noise = torch.from_numpy(rng.normal(0, 0.1 if hidden else 0.01, (1, 2, 11))).float()
        weight = torch.full((1, 2, len(GROUPS)), 1.0 if hidden else 100.0)
        found = average.add(true + noise, weight, hand)
        off.append(((found[:, :3] - true[:, 0, :3]).norm() / noise[0, 0, :3].norm()).item())
        known = F.pad(keys[[stage], :7], (0, 1), value=1.0)
        left = torch.cat([tcp[[29 if stage else tick]], torch.full((1, 1), float(stage))], 1)
        wanted = true_pose(hand, torch.stack([left, known, known], 1))
        assert (found - wanted)[0, 3:].abs().max() < (0.6 if tick == 0 else 0.2)
        torch.testing.assert_close(found[:, 10:], wanted[:, 10:])
    assert off[0] == pytest.approx(1, abs=1e-3)
    assert max(off[30:33]) < 1  # what followed has been seen all along
    assert np.median(off[10:]) < 0.6
    assert np.median(off[11::3]) < 0.2  # where it is hidden


def test_a_plan_from_beside_ends_where_the_recorded_one_does() -> None:
    generator, n, h = torch.Generator().manual_seed(1), 64, 12
    rotation = torch.eye(3)[:2].flatten().expand(n, 6)
    place = torch.randn(n, 3, generator=generator) / 50
    poses = torch.cat([place, rotation, torch.ones(n, 2)], 1)
    plans = torch.zeros(n, h, 8)
    plans[..., :3] = torch.linspace(0, 0.05, h)[:, None]
    plans[: n // 2, h // 2 :, -1] = 0.08  # the gripper opens
    there, back = set_beside(poses, plans, BatchNoise(generator))
    torch.testing.assert_close(there[: n // 2], poses[: n // 2])
    torch.testing.assert_close(back[: n // 2], plans[: n // 2])
    aside = (there - poses).abs().amax(1) > 0
    assert 0.3 < aside[n // 2 :].float().mean() < 0.7
    # from the hand beside to the recorded one
    turn = Rotation.from_rotvec(back[:, -1, 3:6].numpy())
    left = (poses[:, :3] - plans[:, -1, :3]).numpy()
    np.testing.assert_allclose(there[:, :3] - back[:, -1, :3], turn.apply(left), atol=1e-6)
    np.testing.assert_allclose(there[:, 3:6], turn.apply(poses[:, 3:6].numpy()), atol=1e-6)
    assert (there[:, 9] == 1).all()


def test_turned_plans_go_to_the_turned_key_pose() -> None:
    rng = np.random.default_rng(5)
    tcp, key = _poses(rng, 20), F.pad(_poses(rng, 20), (0, 1))
    poses = true_pose(tcp, torch.stack([key + 0.1, key, key], 1))
    turn = torch.from_numpy(rng.normal(0, 0.3, (20, 1, 3))).float()
    plans = torch.cat([poses[:, None, :3], turn, torch.zeros(20, 1, 2)], 2)
    there, led = face_any_way(poses, plans, BatchNoise(torch.Generator().manual_seed(0)))
    torch.testing.assert_close(led[:, 0, :3], there[:, :3])
    torch.testing.assert_close(there[:, :3].norm(dim=1), poses[:, :3].norm(dim=1))
    torch.testing.assert_close(there[:, 9:], poses[:, 9:])
    assert ((there - poses)[:, :2].norm(dim=1) > 0.01).any()
    # the hand's turn, followed by what is left, is the turn of the key pose, as seen before
    about = torch.atan2(there[:, 1], there[:, 0]) - torch.atan2(poses[:, 1], poses[:, 0])
    A = Rotation.from_euler("z", about[:, None].numpy())
    seen = (A * Rotation.from_rotvec(turn[:, 0].numpy()) * A.inv()).as_rotvec()
    np.testing.assert_allclose(led[:, 0, 3:6], seen, atol=1e-5)
    columns = [poses[:, 3:6], poses[:, 6:9], torch.linalg.cross(poses[:, 3:6], poses[:, 6:9])]
    M = (A * Rotation.from_matrix(torch.stack(columns, 2).numpy()) * A.inv()).as_matrix()
    np.testing.assert_allclose(there[:, 3:9], M[:, :, :2].swapaxes(1, 2).reshape(-1, 6), atol=1e-5)


def test_the_gripper_changes_where_the_hand_rests_at_a_key_pose_and_no_velocity_is_read() -> None:
    images = ImageInputConfig((ft.WRIST,), (96, 96))
    torch.manual_seed(0)
    network = PolicyNetwork(
        PolicyConfig(0, "", images=images, gripper_widths=(0.0, 0.08), representation="body_twist")
    ).eval()
    state = torch.randn(1, 2, 22) / 10
    state[..., 15:] = _poses(np.random.default_rng(0), 1)[:, None]  # at rest
    batch = ObservationBatch(torch.empty(1, 2, 0), state, maps=torch.randn(1, 1, 40, 12, 12).half())

    key, wider = torch.zeros(1, 3, 8), replace(batch, state=state + (torch.arange(22) == 14))
    ends_by = network.condition(batch, key)[0] != network.condition(wider, key)[0]
    assert torch.equal(read_by_end(network)[:20], ends_by[:20])  # of what is not the key pose

    def plan(width: float | None) -> torch.Tensor:
        generator = torch.Generator().manual_seed(0)
        return network.plan(batch, generator, width, KeyPoseAverage(0.3)).actions

    def widths(width: float | None) -> torch.Tensor:
        return plan(width)[..., -1]

    assert network.key_pose
    camera = network.key_pose.cameras[0]
    assert isinstance(camera, CameraReadout)
    last, turns = camera.places[-1], camera.turns[-1]
    assert isinstance(last, torch.nn.Linear) and isinstance(turns, torch.nn.Linear)
    for layer in (last, turns):
        torch.nn.init.zeros_(layer.weight)
        torch.nn.init.zeros_(layer.bias)  # at the key pose
    turns.bias.data[[2, 3]] = 1.0
    for sees_closed, width in ((5.0, 0.0), (-5.0, 0.08)):
        last.bias.data[5] = sees_closed
        assert (widths(0.0) == width).all() and (widths(0.08) == width).all()
    state[:, 0, 17] += 0.002  # moving on
    assert (widths(0.0) == 0).all() and (widths(0.08) == 0.08).all()
    state[:, 0, 17] -= 0.002
    last.bias.data[2] = 0.015  # 15 mm away: the head decides
    assert torch.equal(widths(0.0), widths(None)) and torch.equal(widths(0.08), widths(None))
    last.bias.data[2] = 0.1  # 10 cm away
    assert (widths(0.0) == 0).all() and (widths(0.08) == 0.08).all()
    before = plan(None)
    state[..., 7:14] = 1.0
    torch.testing.assert_close(plan(None), before)
