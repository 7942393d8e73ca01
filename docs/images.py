"""Images of README and docs/rewards.md, from the runs of `make images`; each holds its curves' names and colours."""

import json
import sys
from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngInfo
from PyQt6.QtCore import QTimer, QUrl
from PyQt6.QtGui import QImage
from PyQt6.QtWebEngineWidgets import QWebEngineView
from PyQt6.QtWidgets import QApplication

from touchgoal.control.sensors.clip import read_frames
from touchgoal.rewards.report.plot import curve_colors
from touchgoal.launch.demo import FILMED

WIDTH, HEIGHT = 1120, 1400  # px of the browser's window
ACT = """
const key = (name) => document.dispatchEvent(new KeyboardEvent("keydown", {key: name, bubbles: true}));
key("ArrowDown");
const second = chosen.name;
key("ArrowUp");
show(61);
key("ArrowLeft");  // at 3 s
[chosen.name, second, frame, document.querySelectorAll("#chart path:not(.peak)").length, byId("meanings").getBoundingClientRect().top]
"""


def save(name: str, image: Image.Image, curves: list[str]) -> None:
    about = PngInfo()
    about.add_text("curves", json.dumps(curve_colors(curves)))
    image.save(Path(__file__).parent / f"{name}.png", pnginfo=about, optimize=True)


def photograph(page: Path) -> Image.Image:
    """Check that the page's keys work; return its image in a browser, to the end of the table."""
    app, view, taken = QApplication(sys.argv[:1]), QWebEngineView(), []

    def take(bottom: float) -> None:
        shot = view.grab().toImage().convertToFormat(QImage.Format.Format_RGBA8888)
        data = shot.constBits().asstring(shot.sizeInBytes())
        taken.append(Image.frombytes("RGBA", (shot.width(), shot.height()), data).convert("RGB"))
        taken[0] = taken[0].crop((0, 0, WIDTH, round(bottom)))
        app.quit()

    def check(found: list) -> None:
        assert found[:4] == ["episode_000", "episode_001", 60, len(data["curves"])], found
        QTimer.singleShot(1000, lambda: take(found[4]))

    view.resize(WIDTH, HEIGHT)
    view.loadFinished.connect(lambda _: view.page().runJavaScript(ACT, check))
    view.load(QUrl.fromLocalFile(str(page.resolve())))
    view.show()
    app.exec()
    return taken[0]


runs = Path(sys.argv[1])
frames, _ = read_frames(runs / "demo" / "episode.mp4")
film = Image.fromarray(frames[2 * len(frames) // 3])
save("demo", film.resize((2 * film.width, 2 * film.height)), list(FILMED))
report = runs / "curves" / "report.html"
data = json.loads(report.read_text().split('id="data">')[1].split("</script>")[0])
save("reward_page", photograph(report), data["curves"])
