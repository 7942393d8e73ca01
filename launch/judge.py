"""Say of each episode of a set whether it ended in success: success, failure or unsure, and why.

Verdicts are written into the set (judged.json), beside the outcomes that a person or a simulator recorded.
A page shows the ends, doubtful ones first. With --correct a person decides; that counts in the set from
then on, and the judge learns from it.
"""

import csv
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from touchgoal.runtime.atomic_write import atomic_write
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import RARE, checked_dataclass

if TYPE_CHECKING:
    from touchgoal.episodes.outcomes.judged import JudgedOutcome
    from touchgoal.rewards.judging.judge import Judge, Judgement
    from touchgoal.rewards.report.judged_page import JudgedEnd
    from touchgoal.rewards.sources.episode_trajectories import EpisodeTrajectory


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
    source = open_source(config.source, "front", keys=parse_keys(config.keys))
    trajectories = [t for t in source.trajectories if isinstance(t, EpisodeTrajectory)]
    if not trajectories:
        raise UserError(f"{config.source} is no set of episodes: give one")
    prepared = Reward.of_judge(config.judge, config.encoder).prepare(source.inputs)
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
    ends = _report(said, told, judge, out)
    for end, success in _ask(ends) if config.correct else ():
        verdict, i = "success" if success else "failure", end.trajectory.index
        told[i] = JudgedOutcome(verdict, "person", end.said.cost)
        write_judged(episodes, {i: told[i]})
        judge = judge.corrected(end.said.cost, success)
        judge.save(folder / JUDGE)
    if judge is not prepared.judge:
        _report(said, told, judge, out)


def _report(
    said: "Mapping[EpisodeTrajectory, Judgement]",
    told: "Mapping[int, JudgedOutcome]",
    judge: "Judge",
    out: Path,
) -> "list[JudgedEnd]":
    """Write what the judge, as it is now, and persons say; return it, doubtful ones first."""
    from touchgoal.episodes.outcomes.judged import write_judged
    from touchgoal.rewards.report.judged_page import JudgedEnd, write_judged_page

    middle = sum(judge.limits) / 2  # the doubtful ones are nearest to it, then those near a limit
    ends = [
        JudgedEnd(t, judge.judge(one.parts, one.cost), told.get(t.index))
        for t, one in sorted(said.items(), key=lambda pair: abs(pair[1].cost - middle))
    ]
    write_judged(ends[0].trajectory.episodes, {e.trajectory.index: e.outcome for e in ends})
    rows = [["episode", "verdict", "by", "recorded", "cost", *ends[0].said.parts, "reasons"]]
    for end in sorted(ends, key=lambda end: end.trajectory.index):
        about = [str(end.trajectory.index), end.outcome.verdict, end.outcome.by, end.recorded]
        costs = [f"{cost:.4f}" for cost in (end.said.cost, *end.said.parts.values())]
        rows.append([*about, *costs, "; ".join(end.said.reasons)])
    with atomic_write(out / "judged.csv") as unfinished, unfinished.open("w") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)
    table = f"{judge}\n\n{_table(ends)}"
    print(f"{table}\npage: {write_judged_page(ends, table, out)}")
    return ends


def _table(ends: "Sequence[JudgedEnd]") -> str:
    """Return how many episodes have each verdict, how many of these agree, and the worst reasons."""
    from touchgoal.rewards.report.tables import aligned

    recorded = [name for name in ("success", "failure") if any(e.recorded == name for e in ends)]
    rows = [["verdict", "episodes", *(f"recorded {name}" for name in recorded)]]
    for verdict in ("success", "failure", "unsure"):
        some = [end.recorded for end in ends if end.outcome.verdict == verdict]
        rows.append([verdict, str(len(some)), *(str(some.count(name)) for name in recorded)])
    lines = aligned(rows)
    if sure := [e for e in ends if e.recorded and e.outcome.verdict != "unsure"]:
        agree = sum(end.recorded == end.outcome.verdict for end in sure)
        lines.append(f"{agree} of {len(sure)} verdicts agree with the recorded outcome")
    doubted = [e.said.reasons[0] for e in ends if e.said.reasons and e.said.verdict != "success"]
    lines += ["what differs most in the others:"] if doubted else []
    lines += [f"{n:>5}  {reason}" for reason, n in Counter(doubted).most_common()]
    return "\n".join(lines)


def _ask(ends: "Sequence[JudgedEnd]") -> "Iterator[tuple[JudgedEnd, bool]]":
    """Ask a person about each end that none has told yet; yield the answers, whether it succeeded."""
    print("s and Enter: success; f: failure; Enter alone: leave it; q: end")
    for end in ends:
        answer = "" if end.told else input(f"{end.trajectory.source}  {end.said} > ").strip()
        if answer == "q":
            return
        if answer in ("s", "f"):
            yield end, answer == "s"
