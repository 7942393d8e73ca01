"""The reward: how far each frame of a trajectory is from a goal, in images, touch and words."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import overload

import numpy as np
import torch

from touchgoal.control.features import CONTROL_HZ, FRONT
from touchgoal.control.tactile.sensor_models import SENSORS
from touchgoal.encoders import pretrained
from touchgoal.encoders.preprocess import check_images
from touchgoal.encoders.pretrained import AnyTouchEncoder
from touchgoal.encoders.towers.towers import OfflineTowers, Towers, load_towers
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet
from touchgoal.rewards.curves import Curves
from touchgoal.rewards.distance.normalizer import NORMALIZER, REMEDY, DistanceNormalizer, scene_of
from touchgoal.rewards.features.embedded import EmbeddedEpisode
from touchgoal.rewards.features.embedder import EpisodeEmbedder
from touchgoal.rewards.features.embedding_cache import embed_end, embed_trajectory
from touchgoal.rewards.features.successful_ends import GOAL_FILE, SuccessfulEnds
from touchgoal.rewards.goals import (
    SIDES,
    GoalFile,
    GoalLike,
    Goals,
    GoalSpec,
    Inputs,
    OwnFrame,
    Sentence,
    TouchArrays,
    assign_goals,
    check_goals,
    goals_of_script,
    same_episode,
)
from touchgoal.rewards.judging.judge import JUDGE, Judge, Judgement, find_judge
from touchgoal.rewards.prepared_reward import PreparedReward
from touchgoal.rewards.sources.episode_trajectories import default_goals
from touchgoal.rewards.sources.open_source import open_source
from touchgoal.rewards.sources.trajectory import Source, Trajectory
from touchgoal.rewards.value import REMEDY as VALUE_REMEDY
from touchgoal.rewards.value import VALUE_FORMAT, Value
from touchgoal.runtime.errors import UserError

_ARRAYS = "unknown"  # scene of arrays, which do not say where they were recorded
_FIT = "touchgoal fit-normalizer, on successful episodes of your own"


class Reward:
    """Cost of trajectories to a goal, and the rewards that follow from it.

        reward = touchgoal.Reward(goal="bank:data/episodes")
        curves = reward(images=images, tactile={"left": left, "right": right})
        curves.costs["tactile"]  # (T,): distance to the goal
        curves.rewards["tactile"]  # (T,): -cost
        curves.potential_rewards()["tactile"]  # (T,): Phi' - Phi with Phi = -cost
        env = touchgoal.make("pick-place", reward=reward)

    Encoders are loaded at the first use, once.
    """

    def __init__(
        self,
        goal: GoalLike | Sequence[GoalLike] = (),
        *,
        encoder: str | Path | AnyTouchEncoder | None = None,
        towers: str | Towers | None = None,
        normalizer: str | Path | DistanceNormalizer | None = None,
        plain: bool = False,
        device: str = "cpu",
    ) -> None:
        """Read the goals and the normalizer.

        Args:
            goal: one, or several of which each modality takes the first that applies to it:
                any form of `reward-curves --goal`, such as "episode:data/set#3" or "last";
                a frame number of the trajectory (image and touch);
                an array (height, width, 3), a camera image;
                arrays by name, {"image": ..., "left": ..., "right": ...}, each (height, width, 3),
                of the goal state (touch with the same fingertips and the same background);
                a sentence on how the object feels (touch; or images, with the towers of a CLIP and
                without touch). Default: the trajectory's own last frame; where failures are among
                the episodes of a set, the nearest end of its other successes with the same object.
            encoder: touch encoder: a name ("gelsight_mini"), a folder, or one already loaded; a
                sentence as goal needs one that is aligned with texts. Default: the one that ships
                for the sensor.
            towers: "offline", a CLIP's Hugging Face id or folder, or loaded ones. Default: those that
                the encoder was trained with, "offline" without touch.
            normalizer: what makes a cost of the distances: a file that `touchgoal fit-normalizer`
                wrote, one already read, "encoder" for the one that ships with the encoder, or "none"
                for raw cosine distances. A value beside the file is used. Default: the encoder's one
                for the scene that it was fitted on, simulated pick-and-place; else raw distances.
            plain: plain distances of image, touch and text in place of the parts of the cost.
            device: torch device of the encoders.

        Raises:
            UserError: a goal that is none, a normalizer that cannot be read.
        """
        self.goals = goals_of_script(goal)
        self._encoder, self._towers, self._plain, self._device = encoder, towers, plain, device
        self._normalizer = normalizer  # one read, or "encoder", "none", or None: by the scene
        self._folder: Path | None = None  # of the given normalizer
        self._name, self._judges = "the given normalizer", False
        self.camera, self._feels = FRONT, True  # of a judge: what it was fitted on
        if isinstance(normalizer, str | Path) and str(normalizer) not in ("encoder", "none"):
            self._normalizer = DistanceNormalizer.load(Path(normalizer))
            self._name, self._folder = str(normalizer), Path(normalizer).parent
        self._encoders: dict[str | None, tuple[AnyTouchEncoder, Path | None]] = {}  # by sensor
        self._loaded_towers: dict[str, Towers] = {}  # by name
        self._embedders: dict[tuple[str | None, ...], EpisodeEmbedder] = {}

    @classmethod
    def of_judge(cls, judge: str | Path, encoder: str | None = None) -> "Reward":
        """Return the reward with the goals, units, value and judge of `fit-normalizer --judge`.

        `judge` is its folder, or the name of an encoder that ships with one. It measures what it was
        fitted on: that camera, with its towers, and touch or images alone. UserError: there is no judge.
        """
        folder = find_judge(judge)
        goal, towers = folder / GOAL_FILE, Judge.load(folder / JUDGE).towers or None
        found = cls(GoalFile(goal), encoder=encoder, towers=towers, normalizer=folder / NORMALIZER)
        found._judges, made_with = True, SuccessfulEnds.load(goal).made_with  # by the parts alone
        found.camera, found._feels = made_with.camera or FRONT, bool(made_with.encoder)
        return found

    @overload
    def __call__(
        self, recording: Episode | None = None, *, images: np.ndarray | None = None,
        tactile: Mapping[str, np.ndarray] | None = None, camera: str = FRONT,
        fps: float = CONTROL_HZ,
    ) -> Curves: ...  # fmt: skip
    @overload
    def __call__(
        self, recording: EpisodeSet | str | Path, *, camera: str = FRONT
    ) -> list[Curves]: ...
    def __call__(
        self,
        recording: Episode | EpisodeSet | str | Path | None = None,
        *,
        images: np.ndarray | None = None,
        tactile: Mapping[str, np.ndarray] | None = None,
        camera: str = FRONT,
        fps: float = CONTROL_HZ,
    ) -> Curves | list[Curves]:
        """Return the curves of one trajectory, of an episode, or of each episode of a set.

        Args:
            recording: an episode; or a set of episodes, opened or its folder; or videos (see
                `reward-curves`). Embeddings of a set are kept inside it.
            images: in place of a recording, camera images, uint8 (T, height, width, 3), RGB.
            tactile: images of the fingertip sensors, "left", "right" or both, each as `images`. The
                first 5 must be free of contact: they are the background.
            camera: key of the measured camera.
            fps: frames per second of an episode or of arrays.

        Raises:
            UserError: arrays that are not such images or do not match, a recording that cannot be
                read, a goal that no modality takes.
        """
        if isinstance(recording, EpisodeSet | str | Path):
            return [reward.curves(e) for reward, e in self._embed_set(recording, camera)]
        if recording is None:
            recording, scene = _as_episode(images, tactile, camera), _ARRAYS
        else:
            scene = scene_of(recording.frames)
        reward, embedded = self._embed_episode(recording, camera, fps, scene)
        return reward.curves(embedded)

    @overload
    def judge(self, recording: Episode, *, fps: float = CONTROL_HZ) -> Judgement: ...
    @overload
    def judge(self, recording: EpisodeSet | str | Path) -> list[Judgement]: ...
    def judge(
        self, recording: Episode | EpisodeSet | str | Path, *, fps: float = CONTROL_HZ
    ) -> Judgement | list[Judgement]:
        """Return whether an episode, or each of a set, ended in success: success, failure or unsure.

        UserError: no judge lies beside the normalizer (`touchgoal fit-normalizer --judge`), or as
        for curves.
        """
        if isinstance(recording, Episode):
            found = self._embed_episode(recording, self.camera, fps, scene_of(recording.frames))
            return found[0].judge_episode(found[1])
        ends = self._embed_set(recording, self.camera, embed_end)
        return [reward.judge_episode(e) for reward, e in ends]

    def prepare(self, inputs: Inputs, goals: Sequence[GoalSpec] = ()) -> PreparedReward:
        """Check the goals against what will be measured, load the encoders, choose the normalizer.

        `goals` stand in for the reward's own. UserError: whatever would stop the measurement.
        """
        specs = goals or self.goals or [OwnFrame()]
        if self._judges:
            camera = self.camera if self.camera in inputs.cameras else inputs.camera
            inputs = replace(inputs, sides=inputs.sides if self._feels else (), camera=camera)
        towers = self._towers
        together = towers not in (None, OfflineTowers.name)
        if towers is not None and not isinstance(towers, str):
            together = towers.pretrained_together
        assigned = assign_goals(specs, inputs.modalities, together)
        check_goals(assigned, inputs)
        embedder = self.embedder(inputs)
        sentence = next((spec for spec in specs if isinstance(spec, Sentence)), None)
        if sentence and embedder.encoder is not None and not embedder.knows_words:
            raise UserError(
                f"goal '{sentence}': this touch encoder was not aligned with texts: leave the goal "
                "out, or take an encoder of train-encoder align"
            )
        if "force" in assigned:
            sensor = SENSORS.get(embedder.made_with.sensor)
            if why_not := "the sensor is unknown" if sensor is None else sensor.images_only:
                raise UserError(f"goal '{assigned['force']}': {why_not}")
        normalizer, value, note, folder = self._choose_normalizer(inputs, assigned, embedder)
        parts = normalizer is not None and bool(normalizer.unit) and not self._plain
        if not parts and "force" not in assigned:
            embedder = self.embedder(inputs, parts=False)
        return PreparedReward(embedder, assigned, normalizer, value, note, self._plain, folder)

    def prepare_source(self, source: Source) -> dict[str, PreparedReward]:
        """Prepare for each trajectory of a source, by name; see `prepare`."""
        if self.goals:
            return dict.fromkeys((t.name for t in source.trajectories), self.prepare(source.inputs))
        goals = default_goals(source.trajectories)
        prepared = {g: self.prepare(source.inputs, [g]) for g in dict.fromkeys(goals.values())}
        return {name: prepared[goal] for name, goal in goals.items()}

    def embedder(self, inputs: Inputs, parts: bool = True) -> EpisodeEmbedder:
        """Load the encoders, or return those of earlier recordings like these.

        UserError: no encoder ships for the sensor, it is for another one, or it was aligned with other
        towers.
        """
        key = inputs.camera, inputs.sensor, *inputs.sides[:1], str(parts)
        if key not in self._embedders:
            try:
                torch.zeros(1, device=self._device)
            except (RuntimeError, AssertionError, NotImplementedError) as error:
                why = f"cannot be used here ({str(error).splitlines()[0]})"
                raise UserError(f"--device {self._device} {why}: give cpu") from error
            touch, towers = self._touch_encoder(inputs)[0], self._towers
            if isinstance(towers, str) or towers is None:
                name = towers or (touch and touch.towers) or OfflineTowers.name
                if name not in self._loaded_towers:
                    self._loaded_towers[name] = load_towers(name, self._device)
                towers = self._loaded_towers[name]
            self._embedders[key] = EpisodeEmbedder(towers, touch, inputs.camera or "", parts)
        return self._embedders[key]

    def _touch_encoder(self, inputs: Inputs) -> tuple[AnyTouchEncoder | None, Path | None]:
        """Return the touch encoder, and the folder that may hold a normalizer."""
        if not inputs.sides:
            if self._encoder is not None:
                raise UserError(
                    f"{inputs.name} has no touch: leave the encoder out, or name the video of a "
                    f"fingertip {Path(inputs.name).stem}_tactile_left.mp4"
                )
            return None, pretrained.DEFAULT_ENCODER  # whose normalizer knows images, too
        if inputs.sensor not in self._encoders:
            encoder, folder = self._encoder, None
            if not isinstance(encoder, AnyTouchEncoder):
                path = pretrained.find_encoder(encoder) if encoder else _shipped_for(inputs)
                encoder = pretrained.load_encoder(path, inputs.sensor)
                folder = path if path.is_dir() else None
            encoder.to(self._device)
            self._encoders[inputs.sensor] = encoder, folder
        return self._encoders[inputs.sensor]

    def _choose_normalizer(
        self, inputs: Inputs, goals: Goals, embedder: EpisodeEmbedder
    ) -> tuple[DistanceNormalizer | None, Value | None, str, Path | None]:
        """Return the normalizer, the value beside it, which ones these are, and their folder."""
        given, name, folder, reason = self._normalizer, self._name, self._folder, ""
        if given == "none":
            return None, None, "normalizer: none, raw cosine distances", None
        found = given if isinstance(given, DistanceNormalizer) else None
        if found is None:
            folder = self._touch_encoder(inputs)[1]
            name = str(path := (folder or Path()) / NORMALIZER)
            if folder is None:
                reason = "published weights and loaded encoders come without a normalizer"
            elif not path.is_file():
                reason = f"there is no {path}"
            else:
                found = DistanceNormalizer.load(path)
        if found is not None:
            own = same_episode(goals)
            without = () if self._plain else ("image", "tactile") if self._judges else ("tactile",)
            unfit = found.mismatch(embedder.made_with, goals, own, without)
            if given is None and found.scene != inputs.scene:
                unfit = (
                    f"it was fitted on {found.scene} episodes and the scene here is {inputs.scene}"
                )
            reason = unfit and f"{name} does not apply here: {unfit}"
        if found is None or reason:
            if given is not None:
                raise UserError(f"{reason}; {REMEDY}")
            note = f"raw cosine distances, for {reason}; to normalise them: {_FIT}"
            return None, None, note, None
        value = beside = None
        if folder is not None and VALUE_FORMAT.weights_path(folder).is_file():
            value, beside = Value.load(folder), ", with the value beside it"
            task, towers = inputs.fitted_task, embedder.made_with.towers
            if reason := value.mismatch(task, inputs.cameras, towers):
                reason = f"the value in {folder} does not apply here: {reason}"
                if found is given:
                    raise UserError(f"{reason}; {VALUE_REMEDY}")
                value, beside = None, f"; without the value, for {reason}"
        return found, value, f"normalizer: {name}{beside or ''}", folder

    def _embed_set(
        self,
        recording: EpisodeSet | str | Path,
        camera: str,
        embed: Callable[[EpisodeEmbedder, Trajectory], EmbeddedEpisode] = embed_trajectory,
    ) -> Iterator[tuple[PreparedReward, EmbeddedEpisode]]:
        opened = isinstance(recording, EpisodeSet)
        root, keys = (recording.root, recording.keys) if opened else (Path(recording), None)
        source = open_source(root, camera, keys=keys)
        if source.skipped:
            raise UserError(source.skipped[0].reason)
        prepared = self.prepare_source(source)
        for t in source.trajectories:
            yield prepared[t.name], embed(prepared[t.name].embedder, t)

    def _embed_episode(
        self, episode: Episode, camera: str, fps: float, scene: str
    ) -> tuple[PreparedReward, EmbeddedEpisode]:
        sensor, frames = episode.meta.get("sensor"), episode.frames
        if sensor is None and scene == _ARRAYS and self._encoder is None:
            sensor = pretrained.DEFAULT_ENCODER.name
        about = {"scene": scene, "length": len(episode), "task": episode.task}
        about["sensor"] = sensor and str(sensor)
        inputs = Inputs.of("this trajectory", frames, camera, **about)
        goals = [g.beside(frames) if isinstance(g, TouchArrays) else g for g in self.goals]
        prepared = self.prepare(inputs, goals)
        return prepared, prepared.embedder.embed_chunks([episode], fps, inputs.name)


def _as_episode(
    images: np.ndarray | None, tactile: Mapping[str, np.ndarray] | None, camera: str
) -> Episode:
    names = {"images": camera, **SIDES}
    given = ({} if images is None else {"images": images}) | dict(tactile or {})
    if not given:
        raise UserError("nothing to measure: give images, tactile or both")
    for name, frames in given.items():
        if name not in names:
            raise UserError(f"tactile has no '{name}': give left, right or both")
        check_images(name, frames, ndim=(4,))
    if len({len(frames) for frames in given.values()}) > 1:
        counts = ", ".join(f"{name} {len(frames)}" for name, frames in given.items())
        raise UserError(f"images and tactile must have equally many frames, not {counts}")
    if min(len(frames) for frames in given.values()) < 2:
        raise UserError("a curve needs at least 2 frames")
    return Episode({names[name]: frames for name, frames in given.items()}, "")


def _shipped_for(inputs: Inputs) -> Path:
    images_alone = "or measure the images alone: --towers offline"
    if inputs.sensor is None:
        raise UserError(f"{inputs.name} does not name its sensor: give --encoder, {images_alone}")
    try:
        return pretrained.shipped_encoder_for(inputs.sensor)
    except UserError as error:
        raise UserError(f"{error}; {images_alone}") from None
