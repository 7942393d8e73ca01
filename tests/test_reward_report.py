"""Measuring any data: videos by their names, skipped and resumed trajectories, tables and pages."""

import json
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image
from test_episode_embedder import recorded
from toy_towers import PaintTowers

from touchgoal.control.features import FRONT, TACTILE_LEFT, WRIST
from touchgoal.control.sensors.clip import read_frames
from touchgoal.episodes.film import write_film
from touchgoal.episodes.media import write_video
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeWriter
from touchgoal.launch.__main__ import main
from touchgoal.rewards.curves import Contact, Curves
from touchgoal.rewards.features.embedder import EpisodeEmbedder
from touchgoal.rewards.goals import EpisodeEnds, OwnFrame
from touchgoal.rewards.measure import Measurement, embed_here, write_skipped
from touchgoal.rewards.metrics import measure_curve
from touchgoal.rewards.report.page import write_pages
from touchgoal.rewards.report.plot import CURVES, curve_colors, line_styles, plot
from touchgoal.rewards.report.record import Facts, Record, record_of
from touchgoal.rewards.report.report import report_all
from touchgoal.rewards.report.tables import ends_table, metrics_table, outcome_table
from touchgoal.rewards.report.thumbnails import Thumbnails
from touchgoal.rewards.reward import Reward
from touchgoal.rewards.sources import trajectory
from touchgoal.rewards.sources.episode_trajectories import default_goals
from touchgoal.rewards.sources.open_source import open_source
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import write_image

EPISODE = recorded()
REWARD = Reward("last", towers=PaintTowers())


def facts(outcome: str, last: float, name: str = "a") -> Facts:
    return Facts(
        name=name, source=name, index=0, offset=0, frames=9, fps=20.0, unit="", normalised=True,
        goal={}, own_goal=False, contact=None, contact_source="no touch", object="",
        outcome=outcome, success=outcome == "success" if outcome else None,
        measured={"fused": measure_curve(np.array([1.0, last]), None)}, peaks={}, shown=[], columns=[],
    )  # fmt: skip


@pytest.fixture
def episodes(tmp_path: Path) -> Path:
    """Three successes and a failure with cups, the last success alone with a can."""
    writer = EpisodeWriter(tmp_path / "set")
    for k, what in enumerate(("cup", "cup", "cup", "can")):
        meta = {"success": k != 2, "object": what, "outcome": "drop" if k == 2 else "success"}
        frames = {**EPISODE.frames, FRONT: EPISODE.frames[FRONT] + np.uint8(k)}
        writer.append(replace(EPISODE, frames=frames, meta=meta))
    return tmp_path / "set"


def measure(source: Path, out: Path, reward: Reward = REWARD) -> Measurement:
    opened = open_source(source, "front", with_touch=False)
    rewards = reward.prepare_source(opened)
    first = rewards[opened.trajectories[0].name]
    measurement = Measurement(opened.trajectories, rewards, out, plots=1)
    measurement.run(partial(embed_here, embedder=first.embedder))
    report_all(measurement.records, out, first.provenance())
    return measurement


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_an_interrupted_measurement_goes_on_to_the_same_files(
    episodes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And no episode is embedded twice, neither there nor for another goal."""
    chunks, begun = EpisodeEmbedder.embed_chunks, []

    def interrupted(*arguments: Any, **options: Any) -> Any:
        begun.append(arguments)
        if len(begun) == 3:
            raise KeyboardInterrupt
        return chunks(*arguments, **options)

    monkeypatch.setattr(EpisodeEmbedder, "embed_chunks", interrupted)
    with pytest.raises(KeyboardInterrupt):
        measure(episodes, tmp_path / "resumed")
    assert len(list((tmp_path / "resumed" / "measured").iterdir())) == 2
    measure(episodes, tmp_path / "resumed")
    assert len(begun) == 5, "what was measured is not measured again"
    measure(episodes, tmp_path / "whole")
    measure(episodes, tmp_path / "goal", Reward("frame:3", towers=PaintTowers()))
    assert len(begun) == 5, "another run finds the embeddings inside the set"
    shutil.rmtree(episodes / ".cache")
    measure(episodes, tmp_path / "again")
    assert len(begun) == 9
    whole = contents(tmp_path / "again")
    assert contents(tmp_path / "resumed") == whole == contents(tmp_path / "whole")
    assert {"episode_000.png", "episode_003.csv", "frames.parquet", "report.html"} <= whole.keys()
    assert "episode_001.png" not in whole


def test_another_goal_under_the_same_name_is_measured_anew(episodes: Path, tmp_path: Path) -> None:
    image, out, ends = tmp_path / "goal.png", tmp_path / "out", []
    for frame in (0, -1):
        Image.fromarray(EPISODE.frames[FRONT][frame]).save(image)
        measure(episodes, out, Reward(f"image:{image}", towers=PaintTowers()))
        ends.append(json.loads((out / "metrics.json").read_text()))
    assert ends[0] != ends[1]


def test_videos_are_found_by_their_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """NAME.mp4 with others beside it, folders with front.mp4, and one that is broken."""
    folder = tmp_path / "lab"
    front, touch = EPISODE.frames[FRONT], EPISODE.frames[TACTILE_LEFT]
    for name in ("a2", "a10"):
        write_video(folder / f"{name}.mp4", front, 25)
        write_video(folder / f"{name}_tactile_left.mp4", touch, 25)
    for role in ("front", "tactile_left"):
        write_video(folder / "b" / f"{role}.mp4", front if role == "front" else touch, 25)
    write_video(folder / "c.mp4", front, 25)
    write_video(folder / "c_tactile_left.mp4", touch[:9], 25)
    (folder / "d.mp4").write_bytes(b"no video")
    (folder / "labels.csv").write_text("file,outcome,object\na2.mp4,success,cup\na10.mp4,slip,\n")
    monkeypatch.setattr(trajectory, "_CHUNK_BYTES", 1)  # chunks of 16 frames at most
    source = open_source(folder, "front")
    assert [t.name for t in source.trajectories] == ["a2", "a10", "b"]
    assert [t.offset for t in source.trajectories] == [0, 12, 24]
    assert dict(source.trajectories[1].meta) == {"outcome": "slip", "success": False}
    assert source.inputs.sides == (TACTILE_LEFT,) and source.inputs.camera == FRONT
    [unequal, broken] = source.skipped
    assert "9 frames" in unequal.reason and "no readable video" in broken.reason
    [chunk] = source.trajectories[2].chunks()
    assert set(chunk.frames) == {FRONT, TACTILE_LEFT} and chunk.frames[FRONT].shape == front.shape
    one = open_source(folder / "a2.mp4", "wrist").inputs
    assert (one.camera, one.sides) == (WRIST, (TACTILE_LEFT,))
    gels = [
        write_image(tmp_path / f"{n}.png", touch[0, :n]) or tmp_path / f"{n}.png"
        for n in (240, 120)
    ]
    apart = open_source(folder, "front", background=gels[:1]).trajectories[0]
    np.testing.assert_array_equal(apart.untouched[TACTILE_LEFT], touch[:1])
    assert apart.checksum() != source.trajectories[0].checksum()
    for wrong, says in ((gels[1:], r"\(120, 320\)"), (gels, "its videos")):
        with pytest.raises(UserError, match=says):
            open_source(folder / "a2.mp4", "front", background=wrong)
    line = write_skipped(source.skipped, 5, tmp_path)
    assert line.startswith("2 of 5 skipped") and "c," in (tmp_path / "skipped.csv").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "a.mp4 is no readable video .*: re-encode it"),
        (["--encoder", "gelsight_mini"], "or name the video of a fingertip a_tactile_left.mp4"),
        (["--goal", "image:no.png"], "no.png"),
    ],
)
def test_a_mistake_comes_without_a_notice_before_it(
    options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    path = tmp_path / "a.mp4"
    write_video(path, EPISODE.frames[FRONT], 25)
    if not options:  # the file opens, and no frame of it decodes
        data = path.read_bytes()
        begin, end = data.index(b"mdat") + 4, data.index(b"moov")
        path.write_bytes(data[:begin] + bytes(end - begin) + data[end:])
    with pytest.raises(SystemExit, match=message):
        main(["reward-curves", str(path), *options, "--out", str(tmp_path / "out")])
    assert not capsys.readouterr().out


def test_no_failure_is_measured_to_its_own_end(episodes: Path, tmp_path: Path) -> None:
    source = open_source(episodes, "front")
    goals = default_goals(source.trajectories)
    assert list(goals.values()) == [EpisodeEnds(episodes)] * 3 + [OwnFrame()]  # the only can
    assert set(default_goals(source.trajectories[:2]).values()) == {OwnFrame()}
    write_video(tmp_path / "x.mp4", EPISODE.frames[FRONT], 25)
    (tmp_path / "labels.csv").write_text("file,outcome\nx.mp4,drop\n")
    with pytest.raises(UserError, match="x failed, and .* --goal image:FILE"):
        default_goals(open_source(tmp_path / "x.mp4", "front").trajectories)


class Recorded(trajectory.Trajectory):
    """A recording of which nothing is read."""

    def checksum(self) -> str:
        return ""

    def chunks(self) -> Iterator[Episode]:
        yield from ()


@pytest.mark.parametrize(
    ("touch", "unfit"),
    [([0.0, 0.02, 0.6, 0.5, 0.0], True), ([0.9, 0.8, 0.6, 0.2, 0.0], False)],
    ids=["the hand lets go at the end", "it holds at the end"],
)
def test_no_training_on_an_untouched_goal(touch: list[float], unfit: bool, tmp_path: Path) -> None:
    contact, raw = Contact(2, "detected"), {"tactile": np.array(touch)}
    curves = Curves("a#0", {"tactile": "last"}, 20.0, contact, raw, {})
    seen = Thumbnails(5)
    seen.add(Episode({TACTILE_LEFT: np.zeros((len(seen.planned), 24, 32, 3), np.uint8)}, "hold"))
    record = record_of(curves, Recorded("a", "a#0", 0, 0, 5, 20.0, {}), seen)
    assert record.facts.goal_untouched == unfit
    record.save(path := tmp_path / "a.npz")
    said = report_all([path], tmp_path, {})
    assert said.startswith("in 1 of 1 the goal is untouched") if unfit else said == ""


def test_outcomes_are_compared_by_goals_of_others_alone() -> None:
    some = [facts("success", 0.1), facts("success", 0.3), facts("drop", 0.2), facts("drop", 0.9)]
    own = replace(some[0], own_goal=True)
    table = outcome_table([*some, own])
    row = next(line.split() for line in table.splitlines() if line.startswith("fused"))
    assert row[1:] == ["0.20", "0.55", "0.75"]
    assert "none: every goal" in outcome_table([own])


def test_printed_tables_are_short_and_name_the_objects() -> None:
    """The fused curve and four others, a legend of what is shown, each trajectory's last cost."""
    metrics = measure_curve(np.linspace(1, 0, 40), None)
    measured = {name: metrics for name in (*"abcdef", "fused")}
    some = [replace(facts("success", 0.1, name), object=name, measured=measured) for name in "xy"]
    some = [replace(one, goal={"text": "text:a hard ball"}) for one in some]
    table = metrics_table(some, most=4)
    assert [line.split()[0] for line in table.splitlines()[2:8]] == ["curve", "fused", *"abcd"]
    assert "2 more curves" in table and "lag" not in table and "undefined" not in table
    ends = ends_table(some)
    assert ends.splitlines()[2].split()[:3] == ["x", "x", "0.00"]
    assert "describe some of them only" in ends
    assert "describe" not in ends_table([replace(one, object="cup") for one in some])


def test_a_curve_has_one_colour_and_a_lone_one_is_solid() -> None:
    alone, beside = line_styles(["image"]), line_styles(["image", "tactile", "image+tactile"])
    assert alone["image"]["color"] == beside["image"]["color"] == CURVES["image"]  # of films, too
    assert len({*curve_colors(["front", "top", "side"]).values()}) == 3  # a camera has what is left
    curve = {"image": np.linspace(1, 0, 9)}
    figure = plot(Curves("a", {}, 20.0, Contact(None, "no touch"), curve, {}), about="cup, drop")
    assert [text.get_text() for text in figure.texts] == ["a · cup, drop", "image · goal: "]
    assert figure.axes[0].get_position().x1 > 0.95  # beside it there are no names
    assert alone["image"]["linestyle"] == "-"


def test_a_film_ends_with_its_curves(tmp_path: Path) -> None:
    images, curve = np.zeros((6, 240, 400, 3), np.uint8), {"fused": np.ones(7)}
    write_film(tmp_path / "a.mp4", images, EPISODE, 20, curve)
    assert len(read_frames(tmp_path / "a.mp4")[0]) == 4


def test_tables_for_lerobot(episodes: Path, tmp_path: Path) -> None:
    record = Record.load(measure(episodes, tmp_path).records[1])
    table = pq.read_table(tmp_path / "frames.parquet")
    assert table.num_rows == 48 and table["index"].to_pylist() == list(range(48))
    second = table.slice(12, 12)
    assert set(second["episode_index"].to_pylist()) == {1}
    assert second["cost_image"].to_pylist() == pytest.approx(record.costs["image"], abs=1e-6)
    step = record.columns["potential_reward_image"]
    assert second["next.reward"].to_pylist() == pytest.approx([*step[1:], 0], abs=1e-6)
    about = {
        k.decode().removeprefix("lerobot.reward_scoring."): json.loads(v)
        for k, v in table.schema.metadata.items()
        if k.startswith(b"lerobot.")
    }
    assert (about["format"], about["schema_version"]) == ("lerobot.frame_signals", 1)
    signals = set(table.column_names) - {"index", "episode_index", "frame_index"}
    assert about["descriptors"].keys() == signals and about["episode_indices"] == [0, 1, 2, 3]
    assert about["descriptors"]["cost_image"]["direction"] == "lower"
    assert about["provenance"]["camera"] == FRONT and about["provenance"]["normalizer"]
    assert not (tmp_path / "touchgoal_progress.parquet").exists(), "raw distances are no progress"


def addresses(page: Path) -> list[str]:
    return re.findall(r' (?:src|href)="([^"]*)"', page.read_text())


def data_of(page: Path) -> dict[str, Any]:
    text = page.read_text()
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    assert found
    return json.loads(found[1])


@pytest.fixture
def pages(episodes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    measurement = measure(episodes, tmp_path / "out")

    def write(per_page: int) -> Path:
        monkeypatch.setattr("touchgoal.rewards.report.page.PER_PAGE", per_page)
        all_facts = [Record.load(path).facts for path in measurement.records]
        return write_pages(measurement.records, all_facts, tmp_path / "out", ["title\n<b>"])

    return write


def test_page_holds_everything(pages: Callable[..., Path]) -> None:
    page = pages(100)
    data = data_of(page)
    assert data["unit"] == "cosine distance to goal"
    assert data["styles"]["image"]["color"] == CURVES["image"]
    assert addresses(page) == [] and "&lt;b&gt;" in page.read_text()
    assert [e["outcome"] for e in data["episodes"]] == ["success", "success", "drop", "success"]
    first = data["episodes"][0]
    assert len(first["curves"]["image"]) == 12 and first["shown"] == list(range(12))
    sheet = first["sheets"]["front"]
    assert (sheet["columns"], sheet["width"], sheet["height"]) == (8, 32, 32)
    index = pages(3)
    names = ["report.html", "report_001.html", "report_002.html"]
    assert addresses(index) == names
    assert "curves" not in data_of(index)["episodes"][0]
    assert data_of(index)["episodes"][3]["page"] == "report_002.html#episode_003"
    assert len(data_of(index.with_name("report_002.html"))["episodes"]) == 1
