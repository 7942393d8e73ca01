"""Say of each episode of a set whether it ended in success: success, failure or unsure, and why.

Verdicts are written into the set (judged.json), beside the outcomes that a person or a simulator recorded.
A page shows the ends, doubtful ones first. With --correct a person decides; that counts in the set from
then on, and the judge learns from it.
"""

import sys
from pathlib import Path
from typing import Annotated

import tyro

from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import RARE, checked_dataclass


@checked_dataclass
class Config:
    """Options of judge."""

    source: Annotated[Path, tyro.conf.Positional]
    """A set of episodes."""
    judge: str = "gelsight_mini"
    """Folder of fit-normalizer --judge, or the name of an encoder that ships with a judge: the default's
    is of simulated pick-and-place."""
    correct: bool = False
    """Then ask a person about each episode, doubtful ones first; answers also go into the judge."""
    keys: Annotated[tuple[str, ...], RARE] = ()
    """Keys of a LeRobot set whose features have other names: STORED=KEY, such as
    observation.images.top=observation.images.front."""
    encoder: str | None = None
    """Touch encoder that the judge was fitted with. Default: the one that ships for the episodes' sensor."""
    out: Path | None = None
    """Folder of the run."""


def main(config: Config) -> None:
    """Check, judge, write the verdicts, and ask if wanted."""
    from touchgoal.episodes.keys import parse_keys
    from touchgoal.episodes.outcomes.judged import JudgedOutcome, read_judged, write_judged
    from touchgoal.rewards.features.embedding_cache import embed_end
    from touchgoal.rewards.judging.judge import JUDGE, Judgement, find_judge
    from touchgoal.rewards.measure import write_skipped
    from touchgoal.rewards.report.judged_page import ask, report
    from touchgoal.rewards.reward import Reward
    from touchgoal.rewards.sources.episode_trajectories import EpisodeTrajectory
    from touchgoal.rewards.sources.open_source import open_source
    from touchgoal.rewards.sources.trajectory import Skipped
    from touchgoal.runtime.progress import track
    from touchgoal.runtime.run_folder import open_run

    if config.correct and (sys.stdin is None or not sys.stdin.isatty()):
        raise UserError("--correct asks a person: run it in a terminal")
    folder = find_judge(config.judge)
    if config.correct and not Path(config.judge).is_dir():
        raise UserError(
            f"--correct teaches the judge, and {folder} came with touchgoal: copy it first"
        )
    reward = Reward.of_judge(config.judge, config.encoder)
    source = open_source(config.source, reward.camera, keys=parse_keys(config.keys))
    trajectories = [t for t in source.trajectories if isinstance(t, EpisodeTrajectory)]
    if not trajectories:
        raise UserError(f"{config.source} is no set of episodes: give one")
    prepared = reward.prepare(source.inputs)
    judge, episodes = prepared.judge, trajectories[0].episodes
    told = {i: one for i, one in read_judged(episodes).items() if one.by == "person"}
    out = open_run(config.out, "judge", config)
    skipped, said = list(source.skipped), dict[EpisodeTrajectory, Judgement]()
    for t in track(trajectories, "judging", "episode"):
        try:
            said[t] = prepared.judge_episode(embed_end(prepared.embedder, t))
        except UserError as error:
            skipped.append(Skipped(t.name, str(error)))
    if not said:
        raise UserError(f"nothing could be judged: {skipped[0].reason}")
    print(write_skipped(skipped, len(said) + len(skipped), out))
    ends = report(said, told, judge, out)
    for end, success in ask(ends) if config.correct else ():
        verdict, i = "success" if success else "failure", end.trajectory.index
        told[i] = JudgedOutcome(verdict, "person", end.said.cost)
        write_judged(episodes, {i: told[i]})
        judge = judge.corrected(end.said.cost, success)
        judge.save(folder / JUDGE)
    if judge is not prepared.judge:
        report(said, told, judge, out)
