"""Embedding of trajectories and goals with frozen encoders, in one go or piece by piece."""

import hashlib
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from itertools import chain

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from touchgoal.control.arrays import Images
from touchgoal.control.features import CAMERAS, FRONT, TACTILE, TRUTH_CONTACT
from touchgoal.control.tactile.background import first_steady, untouched_frames
from touchgoal.control.tactile.sensor_models import SENSORS
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone
from touchgoal.encoders.pretrained import AnyTouchEncoder
from touchgoal.encoders.towers.towers import OfflineTowers, Towers
from touchgoal.episodes.schema import Episode, MetaValue, is_camera
from touchgoal.episodes.touches import check_touch, touch_background
from touchgoal.rewards.curves import Contact
from touchgoal.rewards.distance.normalizer import EmbeddingSource
from touchgoal.rewards.features.contact_reading import ContactReader
from touchgoal.rewards.features.embedded import (
    ARM,
    IMAGE,
    TEXT,
    TOUCH,
    EmbeddedEpisode,
    EmbeddedGoal,
    Features,
    camera_name,
    join_rows,
    last_rows,
    map_name,
    split_features,
    take_rows,
)
from touchgoal.rewards.features.steady_images import STEADY, steady_images
from touchgoal.rewards.features.successful_ends import SuccessfulEnds
from touchgoal.rewards.goals import (
    EpisodeEnds,
    GoalFile,
    GoalImage,
    Goals,
    GoalSpec,
    GripForce,
    Modality,
    OwnFrame,
    Sentence,
    TouchArrays,
    frame_index,
    missing_camera,
    same_episode,
)
from touchgoal.rewards.metrics import START_FRAMES
from touchgoal.runtime.errors import UserError

Frames = Mapping[str, np.ndarray]
"""Frames by key, (n, ...) each; keys other than cameras, fingertips and `ARM` are ignored."""


class EpisodeEmbedder:
    """Embeds trajectories and goals with frozen encoders.

    The background of each fingertip is the median of the episode's first 5 frames, or of those before the
    first touch, which must not be in the first one.
    """

    def __init__(
        self,
        towers: Towers,
        encoder: AnyTouchEncoder | None,
        camera: str = FRONT,
        parts: bool = True,
    ) -> None:
        """Take the encoders.

        UserError: the encoder was trained with other towers.

        Args:
            encoder: touch encoder (put into evaluation mode), which takes sentences if it was aligned
                with these towers; None to measure images alone.
            camera: key of the camera whose images are measured; "" without images.
            parts: embed everything that the parts of a cost need: both cameras, their maps, and the
                contact of the fingertips; else one camera and touch.
        """
        self.towers, self.encoder = towers, encoder
        self._aligned = encoder if encoder is not None and encoder.towers else None
        self.knows_words = self._aligned is not None  # touch can be compared with sentences
        self.camera, self.parts = camera, parts
        # by the keys that are read, too
        self._ends: dict[tuple[EpisodeEnds | GoalFile, tuple[str, ...]], SuccessfulEnds] = {}
        # A CLIP's name ends in "#" and a hash of its weights; the folder before it may differ.
        name = STEADY if isinstance(towers, OfflineTowers) else towers.name.rpartition("#")[2]
        self._images_with = EmbeddingSource(name, camera)
        self.made_with = self._images_with  # of episodes with touch, if there is an encoder
        if encoder is not None:
            if self._aligned is not None:
                self._aligned.check_towers(towers)
            encoder.eval()
            hashed, sensor = _weights_hash(encoder), encoder.config.sensor or ""
            if parts and (model := SENSORS.get(sensor)) and model.images_only:
                print(model.images_only, file=sys.stderr)
            self.made_with = replace(self._images_with, encoder=hashed, sensor=sensor)

    @cached_property
    def fingerprint(self) -> list[str]:
        """All that an embedding depends on beside the frames: weights, preprocessor, camera, parts."""
        towers = self.towers
        weights = towers.image_weights if isinstance(towers, OfflineTowers) else towers.name
        return [*asdict(self.made_with).values(), weights.rpartition("#")[2], str(self.parts)]

    def embed_chunks(
        self,
        chunks: Iterable[Episode],
        fps: float,
        source: str,
        untouched: Mapping[str, Images] | None = None,
        touch: bool = True,
    ) -> EmbeddedEpisode:
        """Embed the cameras and fingertips of one episode, given whole or in consecutive chunks.

        The first chunk has at least 5 frames, unless it is the whole episode. `untouched` holds frames
        of the fingertips that give their backgrounds in place of its first ones. Without `touch` their
        contact alone is read. UserError: the episode lacks the camera, or starts in contact.
        """
        following = iter(chunks)
        first = next(following)
        truth = first.frames.get(TRUTH_CONTACT)
        if self._sides(first.frames) and truth is not None and truth[0].any():
            raise UserError(
                f"{source} starts in contact, so its fingertips have no background; record it "
                f"with {START_FRAMES} frames before the first touch"
            )
        stream = self.stream({**first.frames, **(untouched or {})}, fps, source)
        truths, pieces = [], []
        for chunk in chain([first], following):
            truths += [] if truth is None else [chunk.frames[TRUTH_CONTACT]]
            pieces.append(stream.embed(chunk.frames, touch))
        features = dict(join_rows([piece.features for piece in pieces]))
        touching = features.get("held") if truth is None else np.concatenate(truths)
        contact = Contact(None, "no touch")
        if touching is not None:
            frames = np.flatnonzero(touching.any(axis=1))
            first_frame = int(frames[0]) if len(frames) else None
            contact = Contact(first_frame, "detected" if truth is None else "truth")
        if not self.parts:
            features.pop("held", None)
        return replace(pieces[0], features=features, contact=contact).with_facts(first.meta)

    def describe(self, embedded: EmbeddedEpisode, meta: Mapping[str, MetaValue]) -> EmbeddedEpisode:
        """Add the sentences about an episode, if touch knows words.

        UserError: its descriptions are no list of sentences.
        """
        sentences = meta.get("descriptions", [])
        if not isinstance(sentences, list):
            raise UserError(f"{embedded.source}: meta descriptions must be a list of sentences")
        if not sentences or self._aligned is None:
            return embedded
        return replace(embedded, descriptions=self.embed_sentences(sentences))

    def stream(self, first: Frames, fps: float, source: str) -> "FeatureStream":
        """Return a stream that embeds a trajectory piece by piece, as `embed_chunks` does.

        `first` holds at least its first frames, which set the background of the fingertips.
        UserError: no camera to measure, or fingertips that do not look untouched.
        """
        sides = self._sides(first)
        if self.camera not in first:
            cameras = [key for key in first if is_camera(key)]
            if cameras or not sides:
                raise UserError(missing_camera(source, self.camera, cameras))
        sensor = SENSORS.get(self.made_with.sensor)
        for side in sides:
            first_steady(first[side], f"{side} of {source}")
            if sensor is not None:
                check_touch(first[side], sensor, f"{side} of {source}")
        about = EmbeddedEpisode(
            {}, self.made_with if sides else self._images_with, source, fps, sides
        )
        return FeatureStream(self, first, about)

    def _sides(self, frames: Frames) -> tuple[str, ...]:
        return tuple(key for key in TACTILE if key in frames) if self.encoder else ()

    def embed_goal(self, goals: Goals, own: EmbeddedEpisode) -> EmbeddedGoal:
        """Embed the goals of one trajectory; frames of `own` are not embedded again.

        UserError: a frame beyond the trajectory, an unreadable image or episode, or an episode
        with other fingertips.
        """
        features: dict[str, np.ndarray] = {}
        if "image" in goals:
            features |= split_features(self._embed_goal("image", goals["image"], own))[0]
        if "tactile" in goals:
            features |= split_features(self._embed_goal("tactile", goals["tactile"], own))[1]
        if isinstance(text := goals.get("text"), Sentence):
            features[TEXT] = self.embed_sentences([text.text])
        if isinstance(force := goals.get("force"), GripForce):
            features["force"] = np.full((1, len(own.sides)), force.newtons, np.float32)
        forms = {name: str(spec) for name, spec in goals.items()}
        return EmbeddedGoal(features, forms, same_episode(goals))

    def embed_cameras(self, frames: Frames) -> Features:
        """Return image, and with parts the pooled features and map of each camera."""
        features: dict[str, np.ndarray] = {}
        offline = self.towers if isinstance(self.towers, OfflineTowers) else None
        others = CAMERAS if self.parts else ()
        for key in dict.fromkeys(key for key in (*others, self.camera) if key in frames):
            images = frames[key] if offline is None else steady_images(frames[key])
            if offline is None or not self.parts:
                pooled = self.towers.embed_images(images)
            else:
                pooled, features[map_name(key)] = offline.embed_with_maps(images)
            features[camera_name(key) if self.parts else IMAGE] = _unit(pooled)
        if self.parts and self.camera in frames:
            features[IMAGE] = features[camera_name(self.camera)]
        return features

    def embed_sentences(self, sentences: Sequence[str]) -> Float32[np.ndarray, "m k"]:
        """Return unit embeddings of sentences on how touch feels, comparable with its embeddings."""
        assert self._aligned is not None  # without it no modality takes a sentence
        return self._aligned.embed_text_goal(list(sentences), self.towers)

    def _embed_goal(self, modality: Modality, spec: GoalSpec, own: EmbeddedEpisode) -> Features:
        """Return the features of a goal; those that are not of the modality do not count."""
        if isinstance(spec, Sentence):
            assert self.towers.pretrained_together  # or a sentence is no goal for images
            return {IMAGE: _unit(self.towers.embed_texts([spec.text]))}
        if isinstance(spec, GoalImage):
            return self.embed_cameras({self.camera or FRONT: spec.read()})
        if isinstance(spec, OwnFrame):
            row = frame_index(spec, len(own), own.source)
            return take_rows(own.features, slice(row, row + 1))
        if isinstance(spec, TouchArrays):
            frames = {
                side: np.stack([*[spec.backgrounds[side]] * START_FRAMES, spec.images[side]])
                for side in own.sides
            }
            return last_rows([self.stream(frames, own.fps, str(spec)).embed(frames)])
        assert isinstance(spec, EpisodeEnds | GoalFile)
        alone = isinstance(spec, EpisodeEnds) and spec.index is not None
        others = [k for k in CAMERAS if k != self.camera and camera_name(k) in own.features]
        keys = (self.camera, *others, *own.sides)
        if alone:  # which may lack what other goals are for
            keys = own.sides if modality == "tactile" else (self.camera, *others)
        ends = self._ends.get((spec, keys))
        if ends is None:
            if isinstance(spec, GoalFile):
                ends = SuccessfulEnds.load(spec.path)
            else:
                embedded = [self.embed_chunks([e], own.fps, n) for n, e in spec.read(also=keys)]
                ends = SuccessfulEnds.of(embedded)
            self._ends[spec, keys] = ends
        return ends.features if alone else ends.for_trajectory(own, str(spec))


class FeatureStream:
    """Embeds consecutive frames of one trajectory; pieces of any length give the same features."""

    def __init__(self, embedder: EpisodeEmbedder, first: Frames, about: EmbeddedEpisode) -> None:
        """Take the background of the fingertips from the first frames; see `embedder.stream`."""
        self._embedder, self._about = embedder, about
        untouched = {side: untouched_frames(first[side]) for side in about.sides}
        self._backgrounds = {side: touch_background(frames) for side, frames in untouched.items()}
        sensor = SENSORS.get(embedder.made_with.sensor) if embedder.parts else None
        # newest frames of each side, for encoders of several
        self._past: dict[str, np.ndarray] = {}
        self._readers = {
            side: ContactReader(sensor, frames, about.fps) for side, frames in untouched.items()
        }

    def embed(self, frames: Frames, touch: bool = True) -> EmbeddedEpisode:
        """Embed the next frames, on request without touch; the first contact is not looked for."""
        features = dict(self._embedder.embed_cameras(frames))
        sides = self._about.sides
        if sides and touch:
            features[TOUCH] = np.stack([self._embed_touch(s, frames[s]) for s in sides], axis=1)
        if self._readers:
            readings = [reader.read(frames[side]) for side, reader in self._readers.items()]
            features |= {k: np.stack([r[k] for r in readings], axis=1) for k in readings[0]}
        if self._embedder.parts:
            features |= {name: frames[key] for name, key in ARM.items() if key in frames}
        return replace(self._about, features=features)

    def _embed_touch(
        self, side: str, frames: UInt8[np.ndarray, "n h w 3"]
    ) -> Float32[np.ndarray, "n k"]:
        """Return embeddings of one fingertip's next images.

        They are unit vectors, except those of a `PooledEncoder`, which are shorter for a lighter touch
        and so farther from a firm one.
        """
        encoder = self._embedder.encoder
        assert encoder is not None  # without it there are no sides
        past = self._past.get(side, frames[:0])
        known = np.concatenate([past, frames]) if len(past) else frames
        self._past[side] = known[len(known) - max(encoder.offsets) :]
        embedded = encoder.embed_frames(known, self._backgrounds[side])[len(past) :]
        if isinstance(encoder, TouchBackbone):
            embedded /= np.linalg.norm(embedded, axis=1, keepdims=True)
        return embedded


def _unit(embeddings: torch.Tensor) -> Float32[np.ndarray, "n d"]:
    return torch.nn.functional.normalize(embeddings.float(), dim=1).cpu().numpy()


def _weights_hash(encoder: AnyTouchEncoder) -> str:
    """Return a short hash of weights and preprocessor, whatever folder they were loaded from."""
    digest = hashlib.sha256(encoder.config.preprocessor.encode())
    for name, weight in sorted(encoder.state_dict().items()):
        digest.update(name.encode())
        digest.update(weight.detach().cpu().numpy().tobytes())
    return digest.hexdigest()[:12]
