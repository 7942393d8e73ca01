"""Synthetic recordings in VisGel's layout with known answers, and tiny random networks of the real classes."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from touchgoal.control.arrays import Image
from touchgoal.encoders.annotation.boxes import Box, Detection
from touchgoal.runtime.image_file import read_image

COLOURS = {"red ball": (210, 40, 40), "green cup": (40, 190, 60), "blue box": (50, 70, 220)}
SENSOR = 26  # px
HEIGHT, WIDTH, FRAMES, CONTACT = 150, 200, 12, 7
PLACES = ((70.0, 95.0), (165.0, 45.0), (160.0, 118.0))  # centres of the objects, px


@dataclass
class Scene:
    """One recording with its ground truth."""

    name: str
    boxes: list[Box]
    colours: list[str]
    touched: int  # index of a box
    place: tuple[float, float]  # middle of the sensor at the contact, px
    fault: str  # "", "no touch", "missed" (by the detector), "unsure" (low scores) or "no sensor"
    detections: list[Detection] = field(default_factory=list)

    @property
    def contact_image(self) -> str:
        return f"data/data_seen/images/vision/0/{self.name}/frame{CONTACT:04d}.png"


def make_scene(number: int, fault: str, rng: np.random.Generator) -> Scene:
    boxes: list[Box] = []
    for x, y in PLACES:
        x, y = x + rng.uniform(-8, 8), y + rng.uniform(-8, 8)
        w, h = rng.uniform(16, 24, 2)
        boxes.append((x - w, y - h, x + w, y + h))
    colours = [str(c) for c in rng.permutation(list(COLOURS))]
    touched = int(rng.integers(3))
    left, top, right, bottom = boxes[touched]
    place = (
        left + (right - left) * rng.uniform(0.3, 0.7),
        top + (bottom - top) * rng.uniform(0.3, 0.7),
    )
    scene = Scene(f"rec_{number:05d}", boxes, colours, touched, place, fault)
    scene.detections = detections_of(scene, rng)
    return scene


def detections_of(scene: Scene, rng: np.random.Generator) -> list[Detection]:
    """True boxes with 10 % jitter, some missed, some found twice, distractors with high and low scores."""
    found = []
    for i, box in enumerate(scene.boxes):
        size = np.tile([box[2] - box[0], box[3] - box[1]], 2)
        missed = rng.random() < 0.1 if i != scene.touched else scene.fault == "missed"
        for twice in range(0 if missed else 1 + int(rng.random() < 0.2)):
            jittered = np.asarray(box) + rng.uniform(-0.1, 0.1, 4) * size / (1 + 3 * twice)
            left, top, right, bottom = jittered.tolist()
            score = rng.uniform(0.1, 0.25) if scene.fault == "unsure" else rng.uniform(0.4, 0.9)
            found.append(Detection((left, top, right, bottom), float(score)))
    unsure = scene.fault == "unsure"
    found.append(Detection((1.0, 1.0, WIDTH - 1.0, HEIGHT - 1.0), 0.2 if unsure else 0.5))  # table
    for score in (0.15, 0.22, 0.2 if unsure else 0.6):  # one of them is sure, in an empty corner
        left, top = rng.uniform(100, 112), rng.uniform(2, 8)
        found.append(Detection((float(left), float(top), float(left + 18), float(top + 14)), score))
    rng.shuffle(found)
    return found


def sensor_box(scene: Scene, frame: int) -> Box:
    """The sensor goes from the left upper corner to the object and stays there."""
    start, end = np.array([20.0, 20.0]), np.asarray(scene.place)
    x, y = (start + (end - start) * min(max(frame - 1, 0) / 6, 1.0)).tolist()
    return (x - SENSOR / 2, y - SENSOR / 2, x + SENSOR / 2, y + SENSOR / 2)


def draw_camera(scene: Scene, frame: int, table: Image, patch: Image) -> Image:
    image = table.copy()
    for box, name in zip(scene.boxes, scene.colours, strict=True):
        left, top, right, bottom = (round(x) for x in box)
        cv2.rectangle(image, (left, top), (right, bottom), COLOURS[name], -1)
        cv2.line(image, (left, top), (right, bottom), (250, 250, 250), 2)
    left, top = (round(x) for x in sensor_box(scene, frame)[:2])
    image[top : top + SENSOR, left : left + SENSOR] = patch
    return image


def draw_touch(scene: Scene, frame: int, gel: Image, rng: np.random.Generator) -> Image:
    """A dent that is deepest in the frame CONTACT."""
    image = gel + rng.normal(0, 1.0, gel.shape)
    depth = 0 if scene.fault == "no touch" else max(0.0, 1 - abs(frame - CONTACT) / 2)
    y, x = np.mgrid[: gel.shape[0], : gel.shape[1]]
    dent = np.exp(-((x - 40) ** 2 + (y - 30) ** 2) / (2 * 8**2))
    image += depth * 40 * dent[:, :, None] * np.array([1, -0.5, 0.7])
    return image.clip(0, 255).round().astype(np.uint8)


def write_png(path: Path, image: Image) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image[:, :, ::-1])


def write_scene(root: Path, scene: Scene, rng: np.random.Generator) -> list[str]:
    """Write one recording and return its lines of the list, in the order of vision2touch."""
    table = rng.integers(95, 125, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    patch = cv2.resize(rng.integers(0, 255, (6, 6, 3), dtype=np.uint8), (SENSOR, SENSOR))
    gel = rng.integers(90, 160, (60, 80, 3)).astype(np.float64)
    names = {
        kind: [
            f"data/data_seen/images/{kind}/0/{scene.name}/frame{i:04d}.png" for i in range(FRAMES)
        ]
        for kind in ("vision", "touch")
    }
    for i in range(FRAMES):
        write_png(root / names["vision"][i], draw_camera(scene, i, table, patch))
        write_png(root / names["touch"][i], draw_touch(scene, i, gel, rng))
    vision, touch = names["vision"], names["touch"]
    return [
        " ".join([vision[0], touch[0], vision[i], touch[i], *(vision[j] for j in near)])
        for i in range(2, FRAMES - 2)
        for near in [(i - 2, i - 1, i + 1, i + 2)]
    ]


class KnownBoxes:
    """`AnnotationModels` that know the scenes; captions name a crop's colour."""

    names = {"detector": "true boxes", "captioner": "colours", "tracker": "CSRT"}

    def __init__(self, root: Path, scenes: Iterable[Scene]) -> None:
        self.detected, self.captioned = 0, 0
        self._scene_of = {}
        for scene in scenes:
            for path in (root / Path(scene.contact_image).parent).iterdir():
                image = read_image(path)
                assert image is not None
                self._scene_of[image.tobytes()] = scene, int(path.stem[-4:])

    def detect(self, image: Image, prompt: str) -> list[Detection]:
        scene, frame = self._scene_of[image.tobytes()]
        if prompt == "object":
            self.detected += 1
            return scene.detections
        return [Detection(sensor_box(scene, frame), 0.1 if scene.fault == "no sensor" else 0.8)]

    def caption(self, image: Image, prompt: str) -> str:
        assert prompt == "What specific object is presented in the scene?"
        self.captioned += 1
        middle = np.median(image.reshape(-1, 3), axis=0)
        return "a " + min(COLOURS, key=lambda name: float(np.abs(middle - COLOURS[name]).sum()))


def make_detector(folder: Path) -> Path:
    """A random Grounding DINO of 0.16 M parameters, as transformers stores one."""
    import torch
    from transformers import (
        BertConfig,
        BertTokenizer,
        GroundingDinoConfig,
        GroundingDinoForObjectDetection,
        SwinConfig,
    )
    from transformers.models.grounding_dino.image_processing_pil_grounding_dino import (
        GroundingDinoImageProcessorPil,
    )

    words = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", "object", "robot", "gripper", "?"]
    BertTokenizer(vocab={word: i for i, word in enumerate(words)}).save_pretrained(folder)
    small: dict[str, Any] = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    swin: dict[str, Any] = {"image_size": 64, "embed_dim": 8, "window_size": 4}
    swin |= {"depths": [1] * 4, "num_heads": [1, 1, 2, 2], "out_indices": [2, 3, 4]}
    sizes: dict[str, Any] = {"num_queries": 6, "d_model": 32, "max_text_len": 16}
    sizes |= {"encoder_layers": 1, "decoder_layers": 2}  # with one layer it fails
    text = BertConfig(vocab_size=len(words), intermediate_size=32, **small)
    config = GroundingDinoConfig(backbone_config=SwinConfig(**swin), text_config=text, **sizes)
    torch.manual_seed(0)
    GroundingDinoForObjectDetection(config).save_pretrained(folder)
    size = {"shortest_edge": 128, "longest_edge": 256}  # 64 fails
    GroundingDinoImageProcessorPil(size=size).save_pretrained(folder)
    return folder


def make_captioner(folder: Path) -> Path:
    """A random BLIP-2 of one layer in each part, as transformers stores one."""
    import torch
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import (
        Blip2Config,
        Blip2ForConditionalGeneration,
        Blip2QFormerConfig,
        Blip2VisionConfig,
        OPTConfig,
        PreTrainedTokenizerFast,
    )
    from transformers.models.blip.image_processing_pil_blip import BlipImageProcessorPil

    words = ["<s>", "<pad>", "</s>", "<unk>", "<image>", "What", "specific", "object", "ball", "?"]
    tokenizer = Tokenizer(models.WordLevel({w: i for i, w in enumerate(words)}, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    special = {"bos_token": "<s>", "eos_token": "</s>", "pad_token": "<pad>", "unk_token": "<unk>"}
    PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, additional_special_tokens=["<image>"], **special
    ).save_pretrained(folder)
    small: dict[str, Any] = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    vision = Blip2VisionConfig(intermediate_size=16, image_size=32, patch_size=16, **small)
    between = {"vocab_size": 20, "intermediate_size": 16, "encoder_hidden_size": 16}
    qformer = Blip2QFormerConfig(cross_attention_frequency=1, **between, **small)
    text = OPTConfig(vocab_size=len(words), ffn_dim=16, word_embed_proj_dim=16, **small)
    config = Blip2Config(
        vision_config=vision.to_dict(),
        qformer_config=qformer.to_dict(),
        text_config=text.to_dict() | {"bos_token_id": 0, "pad_token_id": 1, "eos_token_id": 2},
        num_query_tokens=4,
        image_token_index=4,
    )
    torch.manual_seed(0)
    Blip2ForConditionalGeneration(config).save_pretrained(folder)
    BlipImageProcessorPil(size={"height": 32, "width": 32}).save_pretrained(folder)
    return folder
