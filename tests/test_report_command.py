"""`touchgoal report`: what a bug report needs of a run, and no secrets."""

import csv
import io
import json
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from touchgoal.control import features as ft
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeWriter
from touchgoal.launch.__main__ import main
from touchgoal.runtime.run_folder import RECORD


def report_of(run: Path) -> dict[str, bytes]:
    main(["report", str(run)])
    with zipfile.ZipFile(run / "report.zip") as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_a_report_holds_the_end_of_the_run_and_no_secret(tmp_path: Path) -> None:
    cell = tmp_path / "cell.toml"
    cell.write_text('front = "rtsp://anna:s3cret@10.0.0.7/front"\ntwin = "t0ken@127.0.0.1:5000"\n')
    ticks = np.arange(230, dtype=np.uint8)
    frames = {
        ft.STATE: np.repeat(ticks[:, None], 15, 1).astype(np.float32),
        ft.FRONT: np.zeros((230, 16, 16, 3), np.uint8) + ticks[:, None, None, None],
        ft.ACTION: np.zeros((230, 8), np.float32),
    }
    writer = EpisodeWriter(tmp_path / "run" / "episodes", ft.CONTROL_HZ)
    writer.append(Episode(frames, "put it down", {"ending": "arm: reflex"}))
    (tmp_path / "run" / RECORD).write_text(json.dumps({"config": {"cell": str(cell)}}))
    files = report_of(tmp_path / "run")
    rows = list(csv.DictReader(io.StringIO(files["ticks.csv"].decode())))
    assert [rows[i]["seconds"] for i in (0, -1)] == ["1.500", "11.450"]  # the last 10 s
    assert float(rows[-1]["observation.state.gripper.pos"]) == 229
    sheet = cv2.imdecode(np.frombuffer(files["front.jpg"], np.uint8), cv2.IMREAD_COLOR)
    assert (
        sheet is not None
        and sheet.shape == (4 * 16, 8 * 16, 3)
        and abs(float(sheet[-8, -8, 0]) - 229) < 3
    )
    assert json.loads(files["episode.json"])["ending"] == "arm: reflex"
    assert files["cell.toml"].decode() == 'front = "rtsp://...@10.0.0.7/front"\ntwin = "...@127.0.0.1:5000"\n'  # fmt: skip
    assert b"torch" in files["doctor.txt"]


def test_a_run_that_never_began_has_a_report_too(tmp_path: Path) -> None:
    (tmp_path / RECORD).write_text(json.dumps({"config": {"cell": "gone.toml"}}))
    files = report_of(tmp_path)
    assert "episodes" in files["episode.txt"].decode() and b"gone.toml" in files["cell.toml"]
    with pytest.raises(SystemExit, match="is no folder of a run"):
        main(["report", str(tmp_path / "other")])
