"""HTML page of judged episodes: how each ended, in pictures, doubtful ones first."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template

from touchgoal.episodes.outcomes.judged import JudgedOutcome
from touchgoal.rewards.judging.judge import Judgement
from touchgoal.rewards.report.page import data_uri
from touchgoal.rewards.report.thumbnails import Thumbnails
from touchgoal.rewards.sources.episode_trajectories import EpisodeTrajectory
from touchgoal.runtime.atomic_write import write_file

PAGE = "judged.html"
MOST = 100  # episodes with pictures
_FILES = Path(__file__).parent / "page_files"
_HEIGHT = 168  # px


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
    thumbnails = Thumbnails(1, _HEIGHT)
    thumbnails.add(trajectory.read([trajectory.length - 1]))
    return "".join(
        f'<figure><img alt="" src="{data_uri(sheet.tobytes())}"><figcaption>{escape(name)}</figcaption></figure>'
        for name, sheet in thumbnails.sheets().items()
    )
