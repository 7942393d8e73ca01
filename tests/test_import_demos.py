"""Recordings of other formats, written by their own libraries, become the same frames at the same times."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from in_process import run
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from touchgoal.control import features as ft
from touchgoal.control.sensors.clip import read_frames
from touchgoal.episodes.importers.feature_map import FeatureMap, Part, propose_map
from touchgoal.episodes.importers.find_recordings import find_recordings
from touchgoal.episodes.importers.streams import RawEpisode, Stream
from touchgoal.episodes.media import write_video
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError

RNG = np.random.default_rng(0)
STORE = get_typestore(Stores.ROS2_HUMBLE)
JOINTS = [f"fr3_joint{i}" for i in range(1, 8)]
FINGERS = ["fr3_finger_joint1", "fr3_finger_joint2"]
START = 1_700_000_000  # s, of a robot's clock
TIMES = np.arange(12) / 30  # of images; joints tick four times as often
IMAGES = RNG.integers(0, 256, (12, 24, 32, 3), np.uint8)


def joints_at(t: float) -> np.ndarray:
    return np.concatenate([np.sin(t + np.arange(7)), [0.02 + t / 100] * 2])


def robomimic(path: Path) -> Path:
    """A file in the layout of robomimic's documentation, "Dataset Contents"."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps(
            {"env_name": "Lift", "env_kwargs": {"control_freq": 10}}
        )
        for demo in (0, 10, 2):
            group = data.create_group(f"demo_{demo}")
            group.attrs["num_samples"] = 12
            group["actions"] = RNG.normal(size=(12, 7))
            group["rewards"] = np.array([0.0] * 11 + [float(demo != 2)])
            group["states"] = RNG.normal(size=(12, 32))
            for name, shape in (
                ("joint_pos", 7),
                ("joint_vel", 7),
                ("eef_pos", 3),
                ("eef_quat", 4),
            ):
                group[f"obs/robot0_{name}"] = RNG.normal(size=(12, shape)) + demo
            group["obs/robot0_gripper_qpos"] = np.tile([0.02, -0.02], (12, 1))
            group["obs/agentview_image"] = IMAGES
            group["obs/robot0_eye_in_hand_image"] = 255 - IMAGES
            group["next_obs/agentview_image"] = IMAGES[::-1].copy()
    return path


def stamp(t: float) -> dict[str, int]:
    seconds, nanoseconds = divmod(round((START + t) * 1e9), 10**9)
    return {"sec": int(seconds), "nanosec": int(nanoseconds)}


def ros_messages() -> list[tuple[str, str, float, dict]]:
    """Return topic, type, time and content; images are logged 5 ms after they were taken."""
    found = []
    for t in np.arange(0, 0.5, 1 / 120):
        q, header = joints_at(t), {"stamp": stamp(t), "frame_id": ""}
        state = {
            "header": header,
            "name": JOINTS + FINGERS,
            "position": q,
            "velocity": 0 * q,
            "effort": q,
        }
        found.append(("/joint_states", "sensor_msgs/msg/JointState", t, state))
        force = {"force": dict(x=1.0, y=2.0, z=t), "torque": dict(x=0.0, y=0.0, z=0.0)}
        found.append(
            ("/wrench", "geometry_msgs/msg/WrenchStamped", t, {"header": header, "wrench": force})
        )
        place = {
            "position": dict(x=t, y=0.0, z=0.5),
            "orientation": dict(x=0.6, y=0.0, z=0.0, w=0.8),
        }
        found.append(
            ("/tcp", "geometry_msgs/msg/PoseStamped", t, {"header": header, "pose": place})
        )
    for t, image in zip(TIMES, IMAGES, strict=True):
        for topic, pixels in (("/front/image_raw", image), ("/gelsight/left", 255 - image)):
            data = np.ascontiguousarray(pixels[..., ::-1]).ravel()
            content = {"height": 24, "width": 32, "encoding": "bgr8", "is_bigendian": 0, "step": 96}
            content |= {"header": {"stamp": stamp(t), "frame_id": ""}, "data": data}
            found.append((topic, "sensor_msgs/msg/Image", t + 0.005, content))
    return sorted(found, key=lambda m: m[2])


def ros_object(kind: str, content: dict) -> object:
    fields: dict = dict(STORE.fielddefs[kind][1])
    values: dict[str, Any] = {
        k: ros_object(fields[k][1], v) if isinstance(v, dict) else v for k, v in content.items()
    }
    return STORE.types[kind](**values)


def rosbag2(path: Path) -> Path:
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        links = {}
        for topic, kind, t, content in ros_messages():
            if topic not in links:
                links[topic] = writer.add_connection(topic, kind, typestore=STORE)
            data = STORE.serialize_cdr(ros_object(kind, content), kind)
            writer.write(links[topic], int((START + t) * 1e9), data)
    return path


def mcap(path: Path) -> Path:
    schemas, plain = {}, {"header": None}
    with path.open("wb") as file:
        writer = McapWriter(file)
        for topic, kind, t, content in ros_messages():
            if kind not in schemas:
                text, _ = STORE.generate_msgdef(kind, ros_version=2)
                schemas[kind] = writer.register_msgdef(kind, text)
            lists = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in content.items()}
            if "data" in content:
                lists["data"] = content["data"].tobytes()
            log = int((START + t) * 1e9)
            writer.write_message(
                topic, schemas[kind], plain | lists, log_time=log, publish_time=log
            )
        writer.finish()
    return path


def video_table(folder: Path) -> Path:
    folder.mkdir()
    write_video(folder / "front.mp4", IMAGES, 30)
    rows = [",".join(["time", *(f"q_{i}" for i in range(7)), "gripper"])]
    rows += [",".join(map(str, [t, *np.rad2deg(joints_at(t))[:7], 40.0])) for t in TIMES]
    (folder / "arm.csv").write_text("\n".join(rows))
    return folder


def imported(source: Path, **changes: object) -> EpisodeSet:
    """Propose a map, as a person changes it, and import by it."""
    run("import-demos", source.name)
    proposed = Path(f"{source.stem}_map.json")
    with pytest.raises(SystemExit, match="say in task"):
        run("import-demos", source.name, "--map", proposed)
    proposed.write_text(
        json.dumps(json.loads(proposed.read_text()) | {"task": "lift it"} | changes)
    )
    run("import-demos", source.name, "--map", proposed, "--out", "out")
    return EpisodeSet(Path("out/episodes"))


def test_robomimic(here: Path) -> None:
    path = robomimic(here / "lift.hdf5")
    episodes = imported(path)
    assert len(episodes) == 3 and episodes.fps == 10
    assert [episodes.meta(i)["source"] for i in range(3)] == [f"lift/demo_{n}" for n in (0, 2, 10)]
    assert [episodes.meta(i)["success"] for i in range(3)] == [True, False, True]
    frames = episodes.read(1).frames
    with h5py.File(path) as file:
        names = "agentview_image", "robot0_eye_in_hand_image"
        names += tuple(f"robot0_{n}" for n in ("joint_pos", "joint_vel"))
        obs = {name: np.array(file[f"data/demo_2/obs/{name}"]) for name in names}
    np.testing.assert_array_equal(frames[ft.FRONT], obs["agentview_image"])
    np.testing.assert_array_equal(frames[ft.WRIST], obs["robot0_eye_in_hand_image"])
    state = [obs["robot0_joint_pos"], obs["robot0_joint_vel"], np.full((12, 1), 0.04)]
    np.testing.assert_allclose(frames[ft.STATE], np.concatenate(state, 1), rtol=1e-6)
    assert ft.TCP_POSE not in frames  # robosuite's is in the world's frame
    motion = np.diff(obs["robot0_joint_pos"], axis=0, append=obs["robot0_joint_pos"][-1:])
    np.testing.assert_allclose(frames[ft.ACTION][:, :7], motion, atol=1e-5)


@pytest.mark.parametrize("write", [rosbag2, mcap])
def test_ros(here: Path, write: Callable[[Path], Path]) -> None:
    source = write(here / ("bag" if write is rosbag2 else "log.mcap"))
    episodes = imported(source, fps=30)
    frames = episodes.read(0).frames
    np.testing.assert_array_equal(frames[ft.FRONT], IMAGES)
    np.testing.assert_array_equal(frames[ft.TACTILE_LEFT], 255 - IMAGES)
    q = np.stack([joints_at(t) for t in TIMES])
    np.testing.assert_allclose(frames[ft.STATE][:, :7], q[:, :7], atol=1e-6)
    np.testing.assert_allclose(frames[ft.STATE][:, -1], 2 * q[:, -1], atol=1e-6)
    np.testing.assert_allclose(frames[ft.WRENCH][:, 2], TIMES, atol=1e-6)
    np.testing.assert_allclose(frames[ft.TCP_POSE][:, 0], TIMES, atol=1e-6)
    np.testing.assert_allclose(frames[ft.TCP_POSE][0, 3:], (0.8, 0.6, 0, 0), atol=1e-6)  # wxyz
    assert episodes.meta(0)["sensor"] == "gelsight_mini" and episodes.meta(0)["success"] is True


def test_a_table_with_videos_in_degrees_and_millimetres(here: Path) -> None:
    episodes = imported(video_table(here / "take"), fps=15)
    frames = episodes.read(0).frames
    assert len(frames[ft.STATE]) == 6 and episodes.meta(0)["success"] is True
    q = np.stack([joints_at(t)[:7] for t in TIMES[::2]])
    np.testing.assert_allclose(frames[ft.STATE][:, :7], q, atol=1e-6)
    np.testing.assert_allclose(
        frames[ft.STATE][1:-1, 7:14], np.cos(TIMES[2:-2:2, None] + range(7)), atol=1e-2
    )
    np.testing.assert_allclose(frames[ft.STATE][:, -1], 0.04)
    sent = read_frames(here / "take" / "front.mp4")[0][::2]
    np.testing.assert_array_equal(frames[ft.FRONT], sent)


def numbers(n: int = 20, rate: float = 10.0, names: tuple[str, ...] = ()) -> Stream:
    values = RNG.normal(size=(n, len(names) or 8))
    return Stream(np.arange(n) / rate, values.shape[1:], values.__getitem__, names)


def test_a_map_reorders_scales_and_never_reads_ahead() -> None:
    names = (*JOINTS[::-1], "hand")
    stream = numbers(names=names)
    parts = (
        Part("q", tuple(JOINTS)),
        Part("q", tuple(JOINTS), rate=True),
        Part("q", ("hand",), 0.001),
    )
    made = FeatureMap(7, {ft.STATE: parts}).frames(RawEpisode("one", {"q": stream}))[ft.STATE]
    rows = (np.arange(len(made)) / 7 * 10 + 1e-6).astype(int)  # the newest sample at each time
    values = stream.read(np.arange(20))
    np.testing.assert_allclose(made[:, :7], values[rows][:, 6::-1], rtol=1e-6)
    np.testing.assert_allclose(made[:, -1], values[rows, -1] / 1000, rtol=1e-6)


def test_what_does_not_fit_is_named(tmp_path: Path) -> None:
    whole = numbers(names=tuple(JOINTS))
    paused = Stream(np.append(np.arange(19) / 10, 9.0), whole.shape, whole.read, whole.names)
    for stream, part, words in (
        (paused, Part("q"), "pauses for 7.2 s"),
        (whole, Part("x"), "has no x; it has q"),
        (whole, Part("q", ("elbow",)), "has not all of"),
    ):
        with pytest.raises(UserError, match=words):
            FeatureMap(10, {ft.STATE: (part,)}).frames(RawEpisode("one", {"q": stream}))
    with pytest.raises(UserError, match="neither images nor joint"):
        propose_map(RawEpisode("one", {}))
    with pytest.raises(UserError, match="holds no recording"):
        find_recordings(tmp_path, None)
    with h5py.File(tmp_path / "aloha.hdf5", "w") as file:
        file["observations/qpos"], file["action"] = np.zeros((5, 8)), np.zeros((5, 8))
    with pytest.raises(UserError, match="add --fps"):
        find_recordings(tmp_path / "aloha.hdf5", None)
    (found,) = find_recordings(tmp_path / "aloha.hdf5", 50)
    episode = propose_map(found()).frames(found())
    Episode(episode, "any").check()
