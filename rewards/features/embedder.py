"""Embedding of trajectories and goals with frozen encoders."""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from touchgoal.control.features import FRONT, TACTILE, TRUTH_CONTACT
from touchgoal.control.tactile.picture_guard import check_untouched
from touchgoal.control.tactile.sensor_models import SENSORS
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone
from touchgoal.encoders.pretrained import AnyTouchEncoder
from touchgoal.encoders.towers.towers import Towers
from touchgoal.episodes.schema import Episode, is_camera
from touchgoal.episodes.touches import touch_background
from touchgoal.rewards.curves import Contact, first_contact
from touchgoal.rewards.distance.normalizer import EmbeddingSource
from touchgoal.rewards.features.embedded import EmbeddedEpisode, EmbeddedGoal
from touchgoal.rewards.goals import (
    EpisodeEnd,
    Goal,
    GoalPicture,
    GoalSpec,
    PictureGoal,
    Sentence,
    TouchArrays,
    TouchGoal,
    frame_index,
)
from touchgoal.rewards.metrics import START_FRAMES
from touchgoal.runtime.errors import UserError


class EpisodeEmbedder:
    """Embeds trajectories and goals with frozen encoders.

    The background of each fingertip is the median of the episode's first 5 frames, which must be
    free of contact.
    """

    def __init__(
        self, towers: Towers, encoder: AnyTouchEncoder | None, camera: str = FRONT
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
        self._camera = camera
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
        self,
        episode: Episode,
        fps: float,
        source: str,
        descriptions: bool = False,
        contact: Contact | None = None,
    ) -> EmbeddedEpisode:
        """Embed an episode's camera and fingertips; on request the sentences about it, too.

        The first contact is looked for unless it is given. UserError: the episode lacks the camera,
        starts in contact, or has descriptions that are no list of sentences.
        """
        sides = tuple(k for k in TACTILE if k in episode.frames) if self.encoder else ()
        success = episode.meta.get("success")
        return EmbeddedEpisode(
            source=source,
            fps=fps,
            contact=contact or first_contact(episode),
            made_with=self.made_with if sides else self._pictures_with,
            image=self._episode_pictures(episode, source, touch_alone=bool(sides)),
            sides=sides,
            touch=self._episode_touch(episode, sides, source) if sides else None,
            descriptions=self._embed_descriptions(episode, source) if descriptions else None,
            object=str(episode.meta.get("object", "")),
            success=None if success is None else bool(success),
            words=self.knows_words,
        )

    def embed_video(
        self, frames: UInt8[np.ndarray, "n h w 3"], fps: float, source: str
    ) -> EmbeddedEpisode:
        """Embed a plain video or folder of images: images alone, of an unknown camera."""
        return EmbeddedEpisode(
            source=source,
            fps=fps,
            contact=Contact(None, "no touch"),
            made_with=replace(self._pictures_with, camera=""),
            image=self.embed_pictures(frames),
        )

    def embed_goal(self, goal: Goal, own: EmbeddedEpisode) -> EmbeddedGoal:
        """Embed a goal for one trajectory; frames of `own` are not embedded again.

        UserError: a frame beyond the trajectory, an unreadable picture or episode, or an episode
        with other fingertips.
        """
        image = None if goal.image is None else self._goal_picture(goal.image, own)
        touch = None if goal.tactile is None else self._goal_touch(goal.tactile, own)
        text = None if goal.text is None else self.embed_sentences([goal.text.text])[0]
        return EmbeddedGoal(goal.as_dict(), goal.same_episode, image, touch, text)

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

    def _goal_picture(self, spec: PictureGoal, own: EmbeddedEpisode) -> Float32[np.ndarray, " d"]:
        if isinstance(spec, Sentence):
            assert self._towers.pretrained_together  # or a sentence is no goal for pictures
            return _unit(self._towers.embed_texts([spec.text]))[0]
        if isinstance(spec, GoalPicture):
            return self.embed_pictures(spec.read())[0]
        if isinstance(spec, EpisodeEnd):
            camera = self._camera or FRONT
            return self.embed_pictures(spec.read([camera]).frames[camera][-1:])[0]
        return own.pictures()[frame_index(spec, len(own), own.source)]

    def _goal_touch(self, spec: TouchGoal, own: EmbeddedEpisode) -> Float32[np.ndarray, "sides k"]:
        if isinstance(spec, TouchArrays):
            return np.concatenate(
                [self.embed_touch(spec.pictures[k][None], spec.backgrounds[k]) for k in own.sides]
            )
        if isinstance(spec, EpisodeEnd):
            return self._episode_touch(spec.read(own.sides), own.sides, str(spec))[:, -1]
        return own.touches()[:, frame_index(spec, len(own), own.source)]

    def _episode_pictures(
        self, episode: Episode, source: str, touch_alone: bool
    ) -> Float32[np.ndarray, "n d"] | None:
        if self._camera in episode.frames:
            return self.embed_pictures(episode.frames[self._camera])
        cameras = [key for key in episode.frames if is_camera(key)]
        if cameras or not touch_alone:
            raise UserError(missing_camera(source, self._camera, cameras))
        return None

    def _episode_touch(
        self, episode: Episode, sides: Sequence[str], source: str
    ) -> Float32[np.ndarray, "sides n k"]:
        truth = episode.frames.get(TRUTH_CONTACT)
        if truth is not None and truth[:START_FRAMES].any():
            raise UserError(
                f"{source} starts in contact, so its fingertips have no background; record it "
                f"with {START_FRAMES} frames before the first touch"
            )
        pictures = [episode.frames[side] for side in sides]
        backgrounds = [touch_background(p) for p in pictures]
        if (sensor := SENSORS.get(self.made_with.sensor)) is not None:
            for side, background in zip(sides, backgrounds, strict=True):
                check_untouched(background, sensor, f"{side} of {source}")
        return np.stack(
            [self.embed_touch(p, b) for p, b in zip(pictures, backgrounds, strict=True)]
        )

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
