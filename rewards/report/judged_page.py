"""Report of judged episodes, doubtful ones first: table, file, and a page of how each ended, in pictures."""

import csv
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template

from touchgoal.episodes.outcomes.judged import JudgedOutcome, write_judged
from touchgoal.rewards.judging.judge import Judge, Judgement
from touchgoal.rewards.report.page import data_uri
from touchgoal.rewards.report.tables import aligned
from touchgoal.rewards.report.thumbnails import LONE_HEIGHT, Thumbnails
from touchgoal.rewards.sources.episode_trajectories import EpisodeTrajectory
from touchgoal.runtime.atomic_write import atomic_write, write_file

PAGE = "judged.html"
MOST = 100  # episodes with pictures
_FILES = Path(__file__).parent / "page_files"


@dataclass(frozen=True)
class JudgedEnd:
    """An episode and what is said of it."""

    trajectory: EpisodeTrajectory
    said: Judgement  # by the judge
    told: JudgedOutcome | None  # by a person

    @property
    def outcome(self) -> JudgedOutcome:
        """Outcome that counts: a person's, else the judge's."""
        said = self.said
        return self.told or JudgedOutcome(said.verdict, "judge", said.cost, said.reasons)

    @property
    def recorded(self) -> str:
        """Outcome that a person or a simulator recorded; "" if none did."""
        success = self.trajectory.meta.get("success")
        return "" if success is None else "success" if success else "failure"


def write_judged_page(ends: Sequence[JudgedEnd], table: str, out: Path) -> Path:
    """Write the page, with the pictures of the first 100 ends; return its path."""
    of = f"the first {MOST} of {len(ends)}" if len(ends) > MOST else len(ends)
    root = ends[0].trajectory.episodes.root
    page = Template((_FILES / "judged.html").read_text()).substitute(
        title=escape(f"Judged: {root.name}"),
        subheading=escape(f"{root}: {of} episodes, doubtful ones first"),
        style=(_FILES / "page.css").read_text(),
        table=escape(table),
        articles="\n".join(map(_article, ends[:MOST])),
    )
    write_file(out / PAGE, page.encode())
    return out / PAGE


def _article(end: JudgedEnd) -> str:
    verdict, t = end.outcome.verdict, end.trajectory
    facts = [str(t.meta.get("object", "")), f"cost {end.said.cost:.2f}"]
    facts += [f"recorded: {end.recorded}" if end.recorded else "", f"by a {end.outcome.by}"]
    parts = ", ".join(f"{name} {cost:.2f}" for name, cost in end.said.parts.items())
    return (
        f'<article class="{verdict}"><h2>{escape(t.source)}: {verdict}'
        f"<span>{escape(' · '.join(filter(None, facts)))}</span></h2>"
        f"<p>{escape('; '.join(end.said.reasons))}</p><div>{_pictures(t)}</div>"
        f'<p class="hint">{escape(parts)}</p></article>'
    )


def _pictures(trajectory: EpisodeTrajectory) -> str:
    thumbnails = Thumbnails(1, LONE_HEIGHT)
    thumbnails.add(trajectory.read([trajectory.length - 1]))
    return "".join(
        f'<figure><img alt="" src="{data_uri(sheet.tobytes())}"><figcaption>{escape(name)}</figcaption></figure>'
        for name, sheet in thumbnails.sheets().items()
    )


def report(
    said: Mapping[EpisodeTrajectory, Judgement],
    told: Mapping[int, JudgedOutcome],
    judge: Judge,
    out: Path,
) -> list[JudgedEnd]:
    """Write what the judge, as it is now, and persons say; return it, doubtful ones first."""
    middle = sum(judge.limits) / 2  # the doubtful ones are nearest to it, then those near a limit
    ends = [
        JudgedEnd(t, judge.judge(one.parts), told.get(t.index))
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


def _table(ends: Sequence[JudgedEnd]) -> str:
    """Return how many episodes have each verdict, how many of these agree, and the worst reasons."""
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


def ask(ends: Sequence[JudgedEnd]) -> Iterator[tuple[JudgedEnd, bool]]:
    """Ask a person about each end that none has told yet; yield the answers, whether it succeeded."""
    print("s and Enter: success; f: failure; Enter alone: leave it; q: end")
    for end in ends:
        answer = "" if end.told else input(f"{end.trajectory.source}  {end.said} > ").strip()
        if answer == "q":
            return
        if answer in ("s", "f"):
            yield end, answer == "s"
