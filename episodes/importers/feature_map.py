"""Streams of a recording as touchgoal's features: a map that is proposed, and that a person confirms.

Every feature is made of parts of streams, in order; each frame holds the newest sample that the robot had
at its time, nothing from later.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import field, replace

import numpy as np
from jaxtyping import Float, Int, Shaped

from touchgoal.control import features as ft
from touchgoal.episodes.importers.streams import RawEpisode, Stream
from touchgoal.episodes.keys import guess_sides
from touchgoal.episodes.schema import Episode, MetaValue, is_image
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Count, checked_dataclass

_LONGEST_GAP = 0.5  # s for which a stream may pause
_STROKE = 0.08  # m, of a Franka Hand: the width of a gripper that is given as a share
_WRIST = re.compile(r"wrist|hand|gripper|ee_|eef")
_XYZW = ("orientation.w", "orientation.x", "orientation.y", "orientation.z")


@checked_dataclass
class Part:
    """Components of a stream, scaled."""

    stream: str
    components: tuple[int | str, ...] | None = None
    """By number or name, in the order wanted; default: all of them."""
    scale: float | tuple[float, ...] = 1.0
    """Factor from the recording's units to rad, m, N and Nm, or one for each component."""
    add: bool = False
    """Add the components up: two fingers make one width."""
    rate: bool = False
    """Change per second in place of the value: velocities from positions."""


@checked_dataclass
class FeatureMap:
    """Where each feature comes from, and the rate of the frames."""

    fps: Count
    features: dict[str, tuple[Part, ...]] = field(default_factory=dict)
    """Key of touchgoal -> its parts. Without `action`, it is what the joints and the gripper do in the next
    tick."""
    task: str | None = None
    """Task in words, such as "put the cup on the plate"."""
    sensor: str | None = None
    """Name of the fingertip sensor; see touchgoal list sensors."""

    @property
    def feels(self) -> bool:
        """Whether fingertips are among the features."""
        return not self.features.keys().isdisjoint(ft.TACTILE)

    def episode(self, recording: RawEpisode) -> Episode:
        """Return an episode, marked as a success unless the recording knows better; see `frames`."""
        meta: dict[str, MetaValue] = {"task": self.task or "", "source": recording.name}
        meta |= {"sensor": self.sensor or "", "success": recording.success is not False}
        return Episode(self.frames(recording), self.task or "", meta)

    def frames(self, recording: RawEpisode) -> dict[str, Shaped[np.ndarray, "t ..."]]:
        """Return the frames of an episode, from the time at which every stream has begun.

        UserError: a stream is missing, pauses, or does not fit its key.
        """
        streams = recording.streams
        used = {p.stream for parts in self.features.values() for p in parts}
        if missing := sorted(used - streams.keys()):
            raise UserError(f"{recording.name} has no {missing[0]}; it has {', '.join(streams)}")
        begin = max(streams[name].times[0] for name in used)
        end = min(streams[name].times[-1] for name in used)
        at = begin + np.arange(max(int((end - begin) * self.fps + 1e-3) + 1, 0)) / self.fps
        if len(at) < 2:
            raise UserError(f"{recording.name}: the streams of its map share no two frames in time")
        rows = {name: _newest(streams[name], at, f"{recording.name}: {name}") for name in used}
        frames = {}
        for key, parts in self.features.items():
            values = [_values(streams[p.stream], p, rows[p.stream]) for p in parts]
            if not is_image(key):
                dtype = ft.FEATURES[key].dtype if key in ft.FEATURES else "float32"
                frames[key] = np.concatenate(values, axis=1).astype(dtype)
                continue
            _, height, width, _ = values[0].shape  # even, as a video needs it
            frames[key] = values[0][:, : height // 2 * 2, : width // 2 * 2]
        if ft.STATE in frames and ft.ACTION not in frames:
            frames[ft.ACTION] = _next_motion(frames[ft.STATE])
        return frames

    def table(self, recording: RawEpisode) -> str:
        """Return what becomes of a recording's streams, with ranges after scaling, for people."""
        lines = [f"{recording.name}, {self.fps} frames a second:"]
        for key, parts in self.features.items():
            for part in parts:
                stream, name = recording.streams[part.stream], part.stream
                if part.components is not None:
                    name += f" [{', '.join(map(str, part.components))}]"
                name += " added up" * part.add + " per second" * part.rate
                name += "" if part.scale == 1.0 else f" times {part.scale}"
                found = f"{stream.shape[0]} x {stream.shape[1]}" if stream.is_image else ""
                if not stream.is_image:
                    values = _values(stream, part, np.arange(len(stream.times)))
                    found = f"{values.min():.3g} to {values.max():.3g}"
                lines.append(f"  {key:<34}{name}: {found}")
        if ft.STATE in self.features and ft.ACTION not in self.features:
            lines.append(f"  {ft.ACTION:<34}what joints and gripper do in the next tick")
        used = {p.stream for parts in self.features.values() for p in parts}
        left = sorted(recording.streams.keys() - used)
        return "\n".join([*lines, f"  left out: {', '.join(left)}"] if left else lines)


def propose_map(recording: RawEpisode, fps: int | None = None) -> FeatureMap:
    """Guess a map from names, shapes and ranges; a person confirms it.

    `fps`: default that of the slowest images, at most 20. UserError: neither joints nor images.
    """
    streams = recording.streams
    numbers = {n: s for n, s in streams.items() if not s.is_image}
    images = _images({n: s for n, s in streams.items() if s.is_image})
    features = {key: (Part(name),) for key, name in images.items()}
    features |= _state(numbers) | _pose(numbers) | _wrench(numbers)
    if not features:
        raise UserError(f"{recording.name} holds neither images nor joint positions")
    used = [streams[p.stream] for parts in features.values() for p in parts]
    slowest = min(1 / np.median(np.diff(s.times)) for s in used if len(s.times) > 1)
    digit = any("digit" in p.stream.lower() for parts in features.values() for p in parts)
    found = FeatureMap(fps or max(1, min(ft.CONTROL_HZ, round(slowest))), features)
    return replace(found, sensor=("digit" if digit else "gelsight_mini") if found.feels else None)


def _newest(stream: Stream, at: Float[np.ndarray, " t"], name: str) -> Int[np.ndarray, " t"]:
    """Return the number of the newest sample at each time; UserError: the stream pauses."""
    gaps = np.diff(stream.times)
    longest = int(np.argmax(gaps)) if len(gaps) else 0
    if len(gaps) and gaps[longest] > max(_LONGEST_GAP, 5 * np.median(gaps)):
        raise UserError(
            f"{name} pauses for {gaps[longest]:.1f} s, {stream.times[longest] - stream.times[0]:.1f} s "
            "after its beginning"
        )
    return np.searchsorted(stream.times, at + 1e-6, side="right") - 1


def _values(stream: Stream, part: Part, rows: Int[np.ndarray, " t"]) -> Shaped[np.ndarray, "t ..."]:
    needed, back = np.unique(rows, return_inverse=True)
    if stream.is_image:  # gigabytes, which are copied only if images are repeated
        images = stream.read(needed)
        return images if len(needed) == len(rows) else images[back]
    values = stream.read(np.arange(len(stream.times)) if part.rate else needed).astype(float)
    if part.components is not None:
        try:
            columns = [c if isinstance(c, int) else stream.names.index(c) for c in part.components]
            values = values[:, columns]
        except (ValueError, IndexError):
            have = ", ".join(stream.names) or f"{stream.shape[0]} components"
            raise UserError(
                f"{part.stream} has not all of {part.components}: it has {have}"
            ) from None
    values = values * np.asarray(part.scale)
    if part.rate:
        values = np.gradient(values, stream.times, axis=0)[needed]
    values = values.sum(1, keepdims=True) if part.add else values
    return values[back]


def _next_motion(state: Float[np.ndarray, "t s"]) -> Float[np.ndarray, "t a"]:
    joints = (state.shape[1] - 1) // 2
    after = np.concatenate([state[1:], state[-1:]])
    return np.concatenate([(after - state)[:, :joints], after[:, -1:]], axis=1)


def _images(streams: Mapping[str, Stream]) -> dict[str, str]:
    """Return the stream of each key: fingertips by name, one camera on the hand, one beside it."""
    sides = guess_sides(list(streams))
    others = [name for name in streams if name not in sides.values()]
    on_hand = [name for name in others if _WRIST.search(name.lower())]
    beside = [name for name in others if name not in on_hand]
    cameras = {ft.FRONT: beside[:1], ft.WRIST: on_hand[:1]}
    return {key: name for key, (name, *_) in ((k, n) for k, n in cameras.items() if n)} | sides


def _state(numbers: Mapping[str, Stream]) -> dict[str, tuple[Part, ...]]:
    """Return the parts of the arm's state: joint positions, velocities, width of the gripper."""
    found = _named(numbers, r"(joint_?pos(itions?)?|\.position|qpos|(^|[/_])q)$", lambda n: n >= 6)
    if found is None:
        return {}
    stream = numbers[found]
    arm, fingers = _joints(stream)
    turn = _in_degrees(stream, arm)
    parts = [Part(found, arm, turn)]
    speeds = _named(
        numbers, r"(joint_?vel(ocit(y|ies))?|\.velocity|qvel|(^|[/_])dq)$", lambda n: n >= len(arm)
    )
    same = speeds is not None and (numbers[speeds].names == stream.names)
    parts.append(Part(speeds, arm, turn) if speeds and same else Part(found, arm, turn, rate=True))
    if fingers:
        return {ft.STATE: (*parts, Part(found, fingers, add=True))}
    width = _named(numbers, r"gripper\w*|width", lambda n: n in (1, 2))
    return {ft.STATE: (*parts, _width(width, numbers[width]))} if width else {}


def _joints(stream: Stream) -> tuple[tuple[int | str, ...], tuple[int | str, ...]]:
    """Return the arm's joints and the fingers, by their names where there are any."""
    if not stream.names:
        n = 7 if stream.shape[0] >= 7 else 6
        return tuple(range(n)), tuple(range(n, stream.shape[0]))[:2]
    fingers = tuple(n for n in stream.names if re.search("finger|gripper", n))
    arm = [n for n in stream.names if n not in fingers]
    arm.sort(key=lambda name: [int(digits) for digits in re.findall(r"\d+", name)[-1:]])
    return tuple(arm), fingers[:2]


def _in_degrees(stream: Stream, arm: tuple[int | str, ...]) -> float:
    values = _values(stream, Part("", arm), np.arange(len(stream.times)))
    return float(np.pi / 180) if np.abs(values).max() > 2 * np.pi else 1.0


def _width(name: str, stream: Stream) -> Part:
    values = stream.read(np.arange(len(stream.times)))
    if stream.shape[0] == 2:  # two fingers, which robosuite counts in opposite directions
        return Part(name, scale=(1.0, 1.0 if values[:, 1].mean() >= 0 else -1.0), add=True)
    most = float(np.abs(values).max())
    return Part(name, scale=1.0 if most <= 0.2 else _STROKE if most <= 1.0 else 1e-3)


def _pose(numbers: Mapping[str, Stream]) -> dict[str, tuple[Part, ...]]:
    """Return the parts of the tool's pose, xyzw in ROS; robosuite's is in the world's frame, so it is none."""
    for name, stream in numbers.items():
        if stream.names[3:] and stream.names[3].endswith(".x") and "orientation.w" in stream.names:
            return {ft.TCP_POSE: (Part(name, (*stream.names[:3], *_XYZW)),)}
    return {}


def _wrench(numbers: Mapping[str, Stream]) -> dict[str, tuple[Part, ...]]:
    named = next((n for n, s in numbers.items() if s.names[:1] == ("force.x",)), None)
    found = named or _named(numbers, r"wrench|(^|/)ft$|force_torque", (6).__eq__)
    return {ft.WRENCH: (Part(found),)} if found else {}


def _named(numbers: Mapping[str, Stream], pattern: str, fits: Callable[[int], bool]) -> str | None:
    """Return the first stream with such a name and number of components."""
    found = (n for n, s in numbers.items() if re.search(pattern, n.lower()) and fits(s.shape[0]))
    return next(found, None)
