"""Embedding of trajectories and goals with frozen encoders."""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from touchgoal.control.features import FRONT, TACTILE, TRUTH_CONTACT
from touchgoal.control.tactile.picture_guard import check_untouched
from touchgoal.control.tactile.sensor_models import SENSORS
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone
from touchgoal.encoders.pretrained import AnyTouchEncoder
from touchgoal.encoders.towers.towers import MapTowers, Towers
from touchgoal.episodes.schema import Episode, is_camera
from touchgoal.episodes.touches import touch_background
from touchgoal.rewards.curves import ContactSearch
from touchgoal.rewards.distance.normalizer import EmbeddingSource
from touchgoal.rewards.features.embedded import CameraFeatures, EmbeddedEpisode, EmbeddedGoal
from touchgoal.rewards.features.feature_stream import FeatureStream, Frames
from touchgoal.rewards.features.successful_ends import SuccessfulEnds
from touchgoal.rewards.goals import (
    Bank,
    EpisodeEnd,
    Goal,
    GoalFile,
    GoalPicture,
    GoalSpec,
    OwnFrame,
    PictureGoal,
    Sentence,
    TouchGoal,
    frame_index,
)
from touchgoal.rewards.metrics import START_FRAMES
from touchgoal.runtime.errors import UserError


class EpisodeEmbedder:
    """Embeds trajectories and goals with frozen encoders.

    The background of each fingertip is the median of the episode's first 5 frames, which must be
    free of contact. While `with_parts` is true it embeds everything that the parts of a cost need:
    both cameras, their maps, and the contact of the fingertips; otherwise one camera and touch.
    """

    def __init__(
        self,
        towers: Towers,
        encoder: AnyTouchEncoder | None,
        camera: str = FRONT,
    ) -> None:
        """Take the encoders.

        UserError: the encoder was trained with other towers.

        Args:
            encoder: touch encoder (put into evaluation mode), which takes sentences if it was aligned
                with these towers; None to measure images alone.
            camera: key of the camera whose images are measured; "" for a plain video's.
        """
        self._towers = towers
        self.encoder = encoder
        self._aligned = encoder if encoder is not None and encoder.towers else None
        self.knows_words = self._aligned is not None  # touch can be compared with sentences
        self.camera = camera
        self.with_parts = True
        self._ends: dict[Bank | GoalFile, SuccessfulEnds] = {}
        # A CLIP's name ends in "#" and a hash of its weights; the folder before it may differ.
        self._pictures_with = EmbeddingSource(towers.name.rpartition("#")[2], camera)
        self.made_with = self._pictures_with  # of episodes with touch, if there is an encoder
        if encoder is not None:
            if self._aligned is not None:
                self._aligned.check_towers(towers)
            encoder.eval()
            self.made_with = replace(
                self._pictures_with,
                encoder=_weights_hash(encoder),
                sensor=encoder.config.sensor or "",
            )

    @property
    def past_frames(self) -> int:
        """Number of earlier frames that the embedding of a frame depends on."""
        return 0 if self.encoder is None else max(self.encoder.offsets)

    def embed_episode(
        self, episode: Episode, fps: float, source: str, descriptions: bool = False
    ) -> EmbeddedEpisode:
        """Embed an episode's cameras and fingertips; on request the sentences about it, too.

        UserError: the episode lacks the camera, starts in contact, or has descriptions that are no
        list of sentences.
        """
        return self.embed_chunks([episode], fps, source, descriptions)

    def embed_chunks(
        self, chunks: Iterable[Episode], fps: float, source: str, descriptions: bool = False
    ) -> EmbeddedEpisode:
        """Embed consecutive chunks of one episode, as `embed_episode` embeds it in one go.

        The first chunk has at least 5 frames, unless it is the whole episode.
        """
        following = iter(chunks)
        first = next(following)
        truth = first.frames.get(TRUTH_CONTACT)
        if self._sides(first.frames) and truth is not None and truth[:START_FRAMES].any():
            raise UserError(
                f"{source} starts in contact, so its fingertips have no background; record it "
                f"with {START_FRAMES} frames before the first touch"
            )
        stream, search = self.stream(first.frames, fps, source), ContactSearch()
        pieces = []
        for chunk in chain([first], following):
            search.update(chunk)
            pieces.append(stream.embed(chunk.frames))
        success = first.meta.get("success")
        return replace(
            pieces[0].extended(pieces[1:]),
            contact=search.contact,
            descriptions=self._embed_descriptions(first, source) if descriptions else None,
            object=str(first.meta.get("object", "")),
            success=None if success is None else bool(success),
        )

    def stream(self, first: Frames, fps: float, source: str) -> "FeatureStream":
        """Return a stream that embeds a trajectory piece by piece, as `embed_episode` in one go.

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
            if sensor is not None:
                check_untouched(touch_background(first[side]), sensor, f"{side} of {source}")
        # one class by two paths
        return FeatureStream(self, first, sides, fps, source)  # pyright: ignore[reportArgumentType]

    def source_of(self, sides: Sequence[str]) -> EmbeddingSource:
        """Return what embeddings of a trajectory with these fingertips are made with."""
        return self.made_with if sides else self._pictures_with

    def _sides(self, frames: Frames) -> tuple[str, ...]:
        return tuple(key for key in TACTILE if key in frames) if self.encoder else ()

    def embed_goal(self, goal: Goal, own: EmbeddedEpisode) -> EmbeddedGoal:
        """Embed a goal for one trajectory; frames of `own` are not embedded again.

        UserError: a frame beyond the trajectory, an unreadable picture or episode, or an episode
        with other fingertips.
        """
        embedded = EmbeddedGoal(goal.as_dict(), goal.same_episode)
        if goal.image is not None:
            embedded = replace(embedded, **self._goal_pictures(goal.image, own))
        if goal.tactile is not None:
            embedded = replace(embedded, **self._goal_touches(goal.tactile, own))
        if goal.text is not None:
            sentences = [s for s in (goal.text.text, goal.text.baseline) if s]
            text = self.embed_sentences(sentences)
            embedded = replace(embedded, text=text[:1], text_baseline=text[1:])
        return embedded

    def embed_camera(self, frames: UInt8[np.ndarray, "n h w 3"]) -> CameraFeatures:
        """Return features of one camera's images: with a map if parts are wanted."""
        if not self.with_parts or not isinstance(self._towers, MapTowers):
            return CameraFeatures(self.embed_pictures(frames))
        pooled, maps = self._towers.embed_with_maps(frames)
        return CameraFeatures(_unit(pooled), maps)

    def embed_pictures(self, frames: UInt8[np.ndarray, "n h w 3"]) -> Float32[np.ndarray, "n d"]:
        """Return unit embeddings of camera images."""
        return _unit(self._towers.embed_images(frames))

    def embed_touch(
        self, frames: UInt8[np.ndarray, "n h w 3"], background: UInt8[np.ndarray, "h w 3"]
    ) -> Float32[np.ndarray, "n k"]:
        """Return embeddings of one fingertip's images, given the same fingertip untouched.

        They are unit vectors, except those of a `PooledEncoder`, which are shorter for a lighter touch
        and so farther from a firm one.
        """
        assert self.encoder is not None  # without it no trajectory has sides
        embedded = self.encoder.embed_frames(frames, background)
        if isinstance(self.encoder, TouchBackbone):
            embedded /= np.linalg.norm(embedded, axis=1, keepdims=True)
        return embedded

    def embed_sentences(self, sentences: Sequence[str]) -> Float32[np.ndarray, "m k"]:
        """Return unit embeddings of sentences on how touch feels, comparable with `embed_touch`."""
        assert self._aligned is not None  # without it no modality takes a sentence
        return self._aligned.embed_text_goal(list(sentences), self._towers)

    def _goal_pictures(self, spec: PictureGoal, own: EmbeddedEpisode) -> dict[str, Any]:
        """Return the fields of an `EmbeddedGoal` that the goal of the pictures sets."""
        main = self.camera or FRONT
        if isinstance(spec, Sentence):
            assert self._towers.pretrained_together  # or a sentence is no goal for pictures
            return {"image": _unit(self._towers.embed_texts([spec.text]))}
        if isinstance(spec, GoalPicture):
            cameras = {main: self.embed_camera(spec.read())}
            return {"image": cameras[main].pooled, "cameras": cameras}
        if isinstance(spec, Bank | GoalFile):
            end = self._successful_ends(spec, own).for_trajectory(own, str(spec))
            return {"image": end.image, "cameras": end.cameras}
        if isinstance(spec, EpisodeEnd):
            frames = spec.read(tuple(own.cameras) or (main,)).frames
            cameras = {k: self.embed_camera(v[-1:]) for k, v in frames.items() if is_camera(k)}
            return {"image": cameras[main].pooled, "cameras": cameras}
        end = own.take(_one(frame_index(spec, len(own), own.source)))
        return {"image": end.pictures(), "cameras": end.cameras}

    def _goal_touches(self, spec: TouchGoal, own: EmbeddedEpisode) -> dict[str, Any]:
        """Return the fields of an `EmbeddedGoal` that the goal of touch sets."""
        if isinstance(spec, OwnFrame):
            end = own.take(_one(frame_index(spec, len(own), own.source)))
        elif isinstance(spec, Bank | GoalFile):
            end = self._successful_ends(spec, own).for_trajectory(own, str(spec))
        elif isinstance(spec, EpisodeEnd):
            read = spec.read(own.sides)
            end = self.embed_episode(replace(read, meta={}), own.fps, str(spec))
            end = end.take(_one(len(end) - 1))
        else:
            frames = {
                side: np.stack([*[spec.backgrounds[side]] * START_FRAMES, spec.pictures[side]])
                for side in own.sides
            }
            end = self.stream(frames, own.fps, str(spec)).embed(frames).take(_one(START_FRAMES))
        return {"touch": end.touch, "readings": end.readings, "wrench": end.wrench}

    def _successful_ends(self, spec: Bank | GoalFile, own: EmbeddedEpisode) -> SuccessfulEnds:
        """Return the ends of a bank, embedded once; UserError if they were embedded otherwise."""
        if spec not in self._ends:
            if isinstance(spec, GoalFile):
                ends = SuccessfulEnds.load(spec.path)
            else:
                wanted = (*own.cameras, *((self.camera,) if self.camera else ()), *own.sides)
                keys = tuple(dict.fromkeys(wanted))
                ends = SuccessfulEnds.of(
                    [self.embed_episode(e.read(keys), own.fps, str(e)) for e in spec.ends()]
                )
            self._ends[spec] = ends
        ends = self._ends[spec]
        if (reason := ends.frames.made_with.mismatch(own.made_with)) is not None:
            raise UserError(f"goal '{spec}' does not fit {own.source}: {reason}")
        return ends

    def _embed_descriptions(
        self, episode: Episode, source: str
    ) -> Float32[np.ndarray, "m k"] | None:
        sentences = episode.meta.get("descriptions", [])
        if not isinstance(sentences, list):
            raise UserError(f"{source}: meta descriptions must be a list of sentences")
        return self.embed_sentences(sentences) if sentences and self._aligned else None


def check_words(specs: Iterable[GoalSpec], encoder: AnyTouchEncoder | None) -> None:
    """Raise UserError if a goal is a sentence and the touch encoder was not aligned with texts."""
    sentences = [spec for spec in specs if isinstance(spec, Sentence)]
    if sentences and encoder is not None and encoder.towers is None:
        raise UserError(
            f"goal '{sentences[0]}': this touch encoder was not aligned with texts: leave the goal "
            "out, or take an encoder of train-encoder align"
        )


def _one(row: int) -> slice:
    return slice(row, row + 1)


def missing_camera(source: str, camera: str, cameras: Sequence[str]) -> str:
    """Return the message for a source that lacks a camera."""
    there = f"choose --camera {' or '.join(cameras)}" if cameras else "it has no camera"
    return f"{source} has no images of {camera}: {there}"


def _unit(embeddings: torch.Tensor) -> Float32[np.ndarray, "n d"]:
    return torch.nn.functional.normalize(embeddings.float(), dim=1).cpu().numpy()


def _weights_hash(encoder: AnyTouchEncoder) -> str:
    """Return a short hash of weights and preprocessor, whatever folder they were loaded from."""
    digest = hashlib.sha256(encoder.config.preprocessor.encode())
    for name, weight in sorted(encoder.state_dict().items()):
        digest.update(name.encode())
        digest.update(weight.detach().cpu().numpy().tobytes())
    return digest.hexdigest()[:12]
