"""Small files in the layouts of published sets of touch, written as their makers write them."""

import io
import pickle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

UNTOUCHED = {"red": (150, 120, 90), "blue": (80, 110, 160)}


def gel(seed: int, shape: tuple[int, int] = (320, 240), light: str = "red") -> np.ndarray:
    """A smooth image with a bump somewhere."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    place = rng.uniform((0.2, 0.2), (0.8, 0.8)) * shape
    bump = 70 * np.exp(-((y - place[0]) ** 2 + (x - place[1]) ** 2) / 15**2)
    return (np.array(UNTOUCHED[light]) + bump[:, :, None] * (1, -0.5, 0.3)).astype(np.uint8)


def encoded(image: np.ndarray, kind: str = "JPEG") -> bytes:
    """Encode an RGB image with PIL."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, kind, **({"quality": 95} if kind == "JPEG" else {}))
    return file.getvalue()


def write(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(value))


def write_slides(folder: Path, objects: tuple[str, ...] = ("004_sugar_box", "bread")) -> None:
    """Sliding touch as YCB-Slide and Touch-Slide come from Sparsh's page: five recordings an object."""
    for k, name in enumerate(objects):
        light = ("red", "blue")[k % 2]
        for i in range(5):
            frames = [encoded(gel(100 * k + 10 * i + t, light=light)) for t in range(8 + i)]
            write(folder / name / f"dataset_{i}.pkl", frames)
    (folder / "bgs").mkdir()
    for k, light in ((0, "blue"), (10, "red")):
        plain = np.full((320, 240, 3), UNTOUCHED[light], np.uint8)
        (folder / "bgs" / f"bg_{k}.jpg").write_bytes(encoded(plain))


def near(image: np.ndarray, true: np.ndarray) -> bool:
    """Return whether two images differ by no more than JPEG's loss."""
    return bool(np.abs(image.astype(int) - true).mean() < 2)


def write_force_batch(
    batch: Path, sensor: str = "digit", strokes: int = 2, light: str = "red", late: int = 0
) -> dict[int, dict[str, np.ndarray]]:
    """A batch of TacBench's force estimation: eight images a stroke, of which two are untouched.

    Pressing is negative, as a load cell under the probe may have it. Of `late` images more than forces
    `indexes` tells, as in the published flat and sharp batches.
    """
    shape = (320, 240)
    frames, touched, labels = [], [], {}
    for stroke in range(strokes):
        rows = np.arange(8 * stroke + 2, 8 * stroke + 8)
        load = np.linspace(0.5, 3.0, 6)
        forces = np.column_stack([0.3 * load, 0.1 * load, -load])[: 6 - late]
        slip = (np.arange(6) >= 4).astype(np.int64)[: 6 - late]
        labels[stroke] = {"indexes": rows, "forces": forces, "slip_label": slip}
        labels[stroke] |= {"poses": np.zeros((6, 7)), "coef_friction": 0.4}
        plain = np.full((*shape, 3), UNTOUCHED[light], np.uint8)
        frames += [plain] * 2 + [gel(10 * stroke + t, shape, light) for t in range(6)]
        touched += [0] * 2 + [1] * 6
    stored = [encoded(frame, "PNG") for frame in frames]
    name = "digit" if sensor == "digit" else "gelsight"
    write(batch / f"dataset_{name}_00.pkl", stored[:10])
    write(batch / f"dataset_{name}_01.pkl", stored[10:])
    labelled = {"in_contact": np.array(touched), "trajectories": labels}
    write(batch / "dataset_slip_forces.pkl", labelled)
    return labels


def pose_change(shift_x_mm: float, shift_y_mm: float, yaw: float) -> np.ndarray:
    """A motion in the published matrices: x is their second row, y their first."""
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:2, 3] = shift_y_mm, shift_x_mm
    return pose


def write_pose_set(
    folder: Path, bags: int = 2, images: int = 8, shape: tuple[int, int] = (320, 240)
) -> None:
    """TacBench's pose estimation, of the ring finger alone: motions grow by 0.3 mm and 0.2 degrees."""
    for use in ("train", "test"):
        for k, name in enumerate(("pringles", "sugar")):
            for bag in range(bags):
                seed = 1000 * k + 100 * bag + (50 if use == "test" else 0)
                frames = [encoded(gel(seed + t, shape)) for t in range(images)]
                steps = np.arange(images + 1) - images // 2
                poses = [pose_change(0.3 * s, -0.6 * s, np.radians(0.2 * s)) for s in steps]
                value = {"digit_ring": frames, "object_ring_rel_pose_n5": np.stack(poses)}
                write(folder / use / name / f"bag_{bag:02d}.pkl", value)
    (folder / "bgs").mkdir()
    plain = np.full((*shape, 3), UNTOUCHED["red"], np.uint8)
    (folder / "bgs" / "digit_ring.png").write_bytes(encoded(plain, "PNG"))


def write_grasps(path: Path, held: list[bool]) -> None:
    """A file of Feeling of Success: RGB images given to OpenCV's writer, which takes BGR."""
    value: dict[str, list[Any]] = {
        "object_name": [np.bytes_(b"mug") for _ in held],
        "is_gripping": [np.bool_(h) for h in held],
    }
    for f, finger in enumerate("AB"):
        for m, moment in enumerate(("before", "during", "after")):
            frames = [gel(100 * i + 10 * f + m, (240, 320)) for i in range(len(held))]
            stored = [cv2.imencode(".jpg", frame)[1].tobytes() for frame in frames]
            value[f"gelsight{finger}_{moment}"] = stored
    write(path, value)
