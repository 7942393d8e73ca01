"""Embedding of one trajectory piece by piece: a whole episode, a chunk of a video, or a tick."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, UInt8

from touchgoal.control.features import CAMERAS, WRENCH
from touchgoal.control.tactile.sensor_models import SENSORS
from touchgoal.episodes.touches import touch_background
from touchgoal.rewards.curves import Contact
from touchgoal.rewards.features.contact_reading import ContactReader, ContactReadings
from touchgoal.rewards.features.embedded import EmbeddedEpisode
from touchgoal.rewards.metrics import START_FRAMES

if TYPE_CHECKING:
    from touchgoal.rewards.features.embedder import EpisodeEmbedder

Frames = Mapping[str, np.ndarray]
"""Frames by key, (n, ...) each; keys other than cameras, fingertips and wrench are ignored."""


class FeatureStream:
    """Embeds consecutive frames of one trajectory; pieces of any length give the same features."""

    def __init__(
        self,
        embedder: "EpisodeEmbedder",
        first: Frames,
        sides: tuple[str, ...],
        fps: float,
        source: str,
    ) -> None:
        """Take the background of the fingertips from the first frames; see `embedder.stream`."""
        self._embedder, self._sides, self._fps, self._source = embedder, sides, fps, source
        untouched = {side: first[side][:START_FRAMES] for side in sides}
        self._backgrounds = {side: touch_background(frames) for side, frames in untouched.items()}
        sensor = SENSORS.get(embedder.made_with.sensor)
        self._past: dict[
            str, np.ndarray
        ] = {}  # newest frames of each side, for encoders of several
        self._readers = {
            side: ContactReader(sensor, frames, fps)
            for side, frames in untouched.items()
            if embedder.with_parts
        }

    def embed(self, frames: Frames) -> EmbeddedEpisode:
        """Embed the next frames; the first contact is not looked for."""
        embedder, sides = self._embedder, self._sides
        wanted = (*CAMERAS, embedder.camera) if embedder.with_parts else (embedder.camera,)
        cameras = {
            k: embedder.embed_camera(frames[k]) for k in dict.fromkeys(wanted) if k in frames
        }
        main = cameras.get(embedder.camera)
        touch = [self._embed_touch(side, frames[side]) for side in sides]
        return EmbeddedEpisode(
            source=self._source,
            fps=self._fps,
            contact=Contact(None, "not looked for"),
            made_with=embedder.source_of(sides),
            image=None if main is None else main.pooled,
            sides=sides,
            touch=np.stack(touch) if touch else None,
            words=embedder.knows_words,
            cameras=cameras if embedder.with_parts else {},
            readings=self._read(frames) if self._readers else None,
            wrench=frames.get(WRENCH) if embedder.with_parts else None,
        )

    def _embed_touch(
        self, side: str, frames: UInt8[np.ndarray, "n h w 3"]
    ) -> Float32[np.ndarray, "n k"]:
        past = self._past.get(side, frames[:0])
        known = np.concatenate([past, frames]) if len(past) else frames
        self._past[side] = known[len(known) - self._embedder.past_frames :]
        return self._embedder.embed_touch(known, self._backgrounds[side])[len(past) :]

    def _read(self, frames: Frames) -> ContactReadings:
        return ContactReadings.stack(
            [reader.read(frames[side]) for side, reader in self._readers.items()]
        )
