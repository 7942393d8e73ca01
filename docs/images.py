"""Images of README and docs/rewards.md, from the runs of `make images`; each holds its curves' names and colours."""

import json
import sys
from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngInfo
from PyQt6.QtCore import QRect, QTimer, QUrl
from PyQt6.QtWebEngineWidgets import QWebEngineView
from PyQt6.QtWidgets import QApplication

from touchgoal.control.sensors.clip import read_frames
from touchgoal.launch.demo import FILMED
from touchgoal.rewards.report.plot import curve_colors

ACT = """
const key = (name) => document.dispatchEvent(new KeyboardEvent("keydown", {key: name, bubbles: true}));
key("ArrowDown");
const second = chosen.name;
key("ArrowUp"); show(61); key("ArrowLeft");  // at 3 s
[chosen.name, second, frame, document.querySelectorAll("#chart path:not(.peak)").length, byId("meanings").getBoundingClientRect().top]
"""


def save(name: str, image: Image.Image, curves: list[str]) -> None:
    """Write an image of the docs with its curves in its metadata."""
    about = PngInfo()
    about.add_text("curves", json.dumps(curve_colors(curves)))
    image.save(Path(__file__).parent / f"{name}.png", pnginfo=about, optimize=True)


def photograph(page: Path, curves: list[str]) -> Image.Image:
    """Check that the page's keys work; return its image in a browser, to the end of the table."""
    app, view, shot = QApplication(sys.argv[:1]), QWebEngineView(), page.with_suffix(".png")

    def check(found: list) -> None:
        assert found[:4] == ["episode_000", "episode_001", 60, len(curves)], found
        box = QRect(0, 0, view.width(), round(found[4]))
        QTimer.singleShot(1000, lambda: app.exit(not view.grab(box).save(str(shot))))

    view.resize(1120, 1400)
    view.loadFinished.connect(lambda _: view.page().runJavaScript(ACT, check))
    view.load(QUrl.fromLocalFile(str(page.resolve())))
    view.show()
    assert app.exec() == 0
    return Image.open(shot).convert("RGB")


runs = Path(sys.argv[1])
frames, _ = read_frames(runs / "demo" / "episode.mp4")
film = Image.fromarray(frames[2 * len(frames) // 3])
save("demo", film.resize((2 * film.width, 2 * film.height)), list(FILMED))
report = runs / "curves" / "report.html"
data = json.loads(report.read_text().split('id="data">')[1].split("</script>")[0])
save("reward_page", photograph(report, data["curves"]), data["curves"])
