"""Published layouts of unlabelled touch, written here as their makers write them."""

import io
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from published_files import UNTOUCHED, encoded, gel, near, write, write_slides

from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.encoders.pretrained import ENCODER_FORMAT, load_encoder
from touchgoal.encoders.ssl.frames import sample_recordings
from touchgoal.episodes.importers.pretraining_clips import read_recordings
from touchgoal.episodes.importers.touch_clip import TouchClip, decode, read_pictures
from touchgoal.launch.__main__ import main
from touchgoal.runtime.errors import UserError


def test_slides_are_upright_digits_with_their_own_untouched_gel(tmp_path: Path) -> None:
    write_slides(tmp_path)
    recordings = read_recordings(tmp_path)
    assert [r.held_out for r in recordings] == 2 * [False, False, False, False, True]
    assert [len(r.open()[0]) for r in recordings] == 2 * [8, 9, 10, 11, 12]
    for k, light in ((0, "red"), (1, "blue")):
        clip, background = recordings[5 * k + 2].open()
        assert clip.sensor == "digit"
        frames = clip.frames([3, 0])
        assert frames.shape == (2, 320, 240, 3)
        assert near(frames[0], gel(100 * k + 23, light=light))
        assert near(background, np.full((320, 240, 3), UNTOUCHED[light]))
    for path in (tmp_path / "bgs").iterdir():
        path.unlink()  # then a recording's usual picture is its background: bumps are nowhere twice
    background = read_recordings(tmp_path)[0].open()[1]
    assert near(background, np.full((320, 240, 3), UNTOUCHED["red"]))


def test_a_lying_digit_is_turned_upright(tmp_path: Path) -> None:
    upright = gel(1)
    lying = np.rot90(upright)  # what a clockwise quarter turn brings back
    for i in range(2):
        write(tmp_path / "mug" / f"dataset_{i}.pkl", [encoded(lying, "PNG")])
    assert np.array_equal(read_recordings(tmp_path)[0].open()[0].frames([0])[0], upright)


def test_touch_and_go_has_red_and_blue_put_back(tmp_path: Path) -> None:
    """Its converter gave RGB to OpenCV's writer, which takes BGR."""
    clips = {f"2022041{i}_031604.pkl": 3 + i for i in range(4)}
    for name, count in clips.items():
        pictures = [gel(t, (480, 640)) for t in range(count)]
        stored = [cv2.imencode(".jpg", picture)[1].tobytes() for picture in pictures]
        write(tmp_path / name, stored)
    recordings = read_recordings(tmp_path)
    assert {r.sensor for r in recordings} == {"gelsight_markers"}
    assert [r.held_out for r in recordings] == [True, False, False, False]  # the shortest quarter
    assert near(recordings[2].open()[0].frames([4])[0], gel(4, (480, 640)))
    assert read_recordings(tmp_path, "gelsight")[0].sensor == "gelsight"
    with pytest.raises(UserError, match=r"with gelsight_markers or gelsight, not digit"):
        read_recordings(tmp_path, "digit")


def test_object_folder_is_a_mini(tmp_path: Path) -> None:
    for i in (1, 2, 3):
        write(tmp_path / f"{i:03d}.pkl", [encoded(gel(i, (240, 320)))])
    recordings = read_recordings(tmp_path)
    assert [r.sensor for r in recordings] == 3 * ["gelsight_mini"]
    assert [r.held_out for r in recordings] == [False, False, True]
    assert near(recordings[2].open()[0].frames([0])[0], gel(3, (240, 320)))
    assert read_recordings(tmp_path, "gelsight_mini_markers")


def test_touches_are_drawn_with_those_before_them(tmp_path: Path) -> None:
    write_slides(tmp_path, ("mug",))
    recordings = read_recordings(tmp_path)[1:3]
    preprocess = preprocessor_for("digit")
    drawn = sample_recordings(recordings, 100, 0, (0, 5))
    assert drawn.touch.shape == (9 + 10, 2, 3, 160, 120) and drawn.stride == 5
    clip, background = recordings[1].open()
    for row, past in ((0, 0), (4, 0), (9, 4)):
        expected = preprocess(clip.frames([row, past]), background)
        assert np.allclose(drawn.touch[9 + row], expected, atol=2e-3)
    alone = sample_recordings(recordings, 3, 0)
    assert alone.touch.shape == (6, 3, 160, 120)
    assert np.array_equal(alone.touch[:3], sample_recordings(recordings[:1], 3, 0).touch)


def test_an_encoder_learns_from_a_published_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, out = tmp_path / "slides", tmp_path / "run"
    write_slides(data)
    toy = "--frames 4 --mae.vit tiny --mae.epochs 1 --mae.batch-size 8".split()
    main(["train-encoder", "mae", "--data", str(data), "--out", str(out), *toy])
    encoder = load_encoder(str(out / "encoder"))
    assert encoder.embed(np.stack([gel(1), gel(2)])).shape[0] == 2  # upright, as a DIGIT's
    recipe = ENCODER_FORMAT.provenance(out / "encoder")
    assert recipe["data"]["train"] == [{"path": data.name, "recordings": 8, "held_out": 2}]
    for words, message in (
        (["--data", str(data), "--sensor", "gelsight_mini"], "with digit, not gelsight_mini"),
        (["--data", str(tmp_path / "none")], "is no folder"),
        (["--data", str(tmp_path)], "none of the published layouts"),
        (["--data", str(data), "--validation", str(data)], "leave --validation out"),
    ):
        with pytest.raises(SystemExit) as refused:
            main(["train-encoder", "mae", *words, "--out", str(tmp_path / "other"), *toy])
        assert message in f"{refused.value.code}{capsys.readouterr().err}"


def test_what_is_no_such_folder_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is no folder"):
        read_recordings(tmp_path / "none")
    with pytest.raises(UserError, match="none of the published layouts"):
        read_recordings(tmp_path)
    write(tmp_path / "001.pkl", [encoded(gel(1))])
    with pytest.raises(UserError, match="one recording: training and validation"):
        read_recordings(tmp_path)
    write(tmp_path / "002.pkl", [])
    with pytest.raises(UserError, match="002.pkl holds no image"):
        read_recordings(tmp_path)
    (tmp_path / "002.pkl").write_bytes(pickle.dumps({"gelsightA_before": [b""]}))
    with pytest.raises(UserError, match="is not a list of encoded images"):
        read_recordings(tmp_path)
    write(tmp_path / "002.pkl", [encoded(gel(1)), encoded(gel(1, (240, 240)))])
    with pytest.raises(UserError, match="images of different sizes"):
        read_recordings(tmp_path)[1].open()[0].frames([0, 1])


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_whatever_byte_is_wrong_frames_are_the_same_or_refused(tmp_path: Path, kind: str) -> None:
    """A PNG's checksums tell every wrong byte; a JPEG that still decodes is whole but for that one."""
    true = [gel(i, (32, 24)) for i in range(4)]
    write(tmp_path / "true.pkl", [encoded(picture, kind) for picture in true])
    whole = TouchClip("true", "digit", read_pictures(tmp_path / "true.pkl"))
    expected = whole.frames(range(4))
    data = (tmp_path / "true.pkl").read_bytes()
    rng = np.random.default_rng(1)
    path = tmp_path / "broken.pkl"
    refused = 0
    for at in rng.permutation(len(data))[:200]:
        broken = bytearray(data)
        broken[at] ^= int(rng.integers(1, 256))
        path.write_bytes(broken)
        try:
            frames = TouchClip("broken", "digit", read_pictures(path)).frames(range(4))
        except UserError:
            refused += 1
            continue
        hit = [0 <= at - data.index(p) < len(p) for p in whole.pictures]
        assert frames.shape == expected.shape
        for i in range(4):
            assert np.array_equal(frames[i], expected[i]) or (kind == "JPEG" and hit[i])
    assert refused > 30


def test_a_picture_of_another_kind_or_a_huge_one_is_refused() -> None:
    bmp = io.BytesIO()
    Image.fromarray(gel(1)).save(bmp, "BMP")
    for data in (b"", b"text", bmp.getvalue(), encoded(gel(1))[:-200], encoded(gel(1), "PNG")[:-1]):
        with pytest.raises(UserError, match="frame 3 is broken, or no JPEG or PNG"):
            decode(data, "frame 3")
    with pytest.raises(UserError, match="make it smaller"):
        decode(encoded(np.zeros((8000, 8000, 3), np.uint8)), "frame 3")
