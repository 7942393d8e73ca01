"""Files in the layout of the published Sparsh encoders, and a forward pass written from the specification."""

import torch
from torch import Tensor

WIDTH, HEADS, DEPTH, PATCH = 192, 3, 2, 16


def published(
    channels: int = 6,
    registers: int = 0,
    layer_scale: bool = True,
    tubelet: int = 1,
    stored: int = 0,  # rows of positions
) -> dict[str, Tensor]:
    """Random weights in timm's names, none of them at a value that would hide it."""
    torch.manual_seed(0)
    tube = (tubelet,) if tubelet > 1 else ()
    shapes: dict[str, tuple[int, ...]] = {
        "patch_embed.proj.weight": (WIDTH, channels, *tube, PATCH, PATCH),
        "patch_embed.proj.bias": (WIDTH,),
        "norm.weight": (WIDTH,),
        "norm.bias": (WIDTH,),
    }
    for i in range(DEPTH):
        for name, rows, columns in (
            ("attn.qkv", 3 * WIDTH, WIDTH),
            ("attn.proj", WIDTH, WIDTH),
            ("mlp.fc1", 4 * WIDTH, WIDTH),
            ("mlp.fc2", WIDTH, 4 * WIDTH),
        ):
            shapes[f"blocks.{i}.{name}.weight"] = (rows, columns)
            shapes[f"blocks.{i}.{name}.bias"] = (rows,)
        vectors = ["norm1.weight", "norm1.bias", "norm2.weight", "norm2.bias"]
        vectors += ["ls1.gamma", "ls2.gamma"] if layer_scale else []
        shapes |= {f"blocks.{i}.{name}": (WIDTH,) for name in vectors}
    if registers:
        shapes["register_tokens"] = (1, registers, WIDTH)
    if stored:
        shapes["pos_embed"] = (1, stored, WIDTH)
    weights = {name: torch.randn(shape) * 0.05 for name, shape in shapes.items()}
    weights["patch_embed.proj.weight"] *= 0.02  # so faint that the LayerNorm's epsilon shows
    for name in weights:
        if "norm" in name and name.endswith("weight"):
            weights[name] += 1
    if not stored:
        axes = 3 if tubelet > 1 else 2
        bands = WIDTH // (2 * axes)
        row = torch.tensor([10000 ** (-k / bands) for k in range(bands)])
        weights["pos_embed.frequency_bands"] = row.repeat(axes, 1)
    return weights


def plain_forward(w: dict[str, Tensor], images: Tensor) -> Tensor:
    """Features (n, d) of one image (c, h, w) or clip (c, t, h, w), one patch and head at a time."""
    kernel = w["patch_embed.proj.weight"]
    clip = images if images.ndim == 4 else images[:, None]
    kernel = kernel if kernel.ndim == 5 else kernel[:, :, None]
    step = kernel.shape[2]
    tokens = []
    for t in range(clip.shape[1] // step):
        for y in range(clip.shape[2] // PATCH):
            for x in range(clip.shape[3] // PATCH):
                tube = clip[:, t * step : (t + 1) * step, y * PATCH :, x * PATCH :]
                tube = tube[:, :, :PATCH, :PATCH].flatten()
                token = kernel.flatten(1) @ tube + w["patch_embed.proj.bias"]
                if "pos_embed" in w:
                    token = token + w["pos_embed"][0, len(tokens)]
                else:
                    bands = w["pos_embed.frequency_bands"]
                    place = (t, y, x)[-len(bands) :]
                    for axis, at in enumerate(place):
                        code = torch.cat([(at * bands[axis]).sin(), (at * bands[axis]).cos()])
                        start = axis * len(code)
                        token[start : start + len(code)] += code
                tokens.append(token)
    x = torch.stack(tokens)
    registers = w["register_tokens"][0] if "register_tokens" in w else x[:0]
    x = torch.cat([registers, x])
    for i in range(DEPTH):
        b = {name.removeprefix(f"blocks.{i}."): value for name, value in w.items()}
        q, k, v = (norm(x, b, "norm1") @ b["attn.qkv.weight"].T + b["attn.qkv.bias"]).chunk(3, 1)
        heads = []
        for qh, kh, vh in zip(q.chunk(HEADS, 1), k.chunk(HEADS, 1), v.chunk(HEADS, 1), strict=True):
            heads.append((qh @ kh.T / (WIDTH / HEADS) ** 0.5).softmax(1) @ vh)
        y = torch.cat(heads, 1) @ b["attn.proj.weight"].T + b["attn.proj.bias"]
        x = x + y * b.get("ls1.gamma", torch.ones(()))
        y = norm(x, b, "norm2") @ b["mlp.fc1.weight"].T + b["mlp.fc1.bias"]
        y = y * (1 + torch.erf(y / 2**0.5)) / 2
        y = y @ b["mlp.fc2.weight"].T + b["mlp.fc2.bias"]
        x = x + y * b.get("ls2.gamma", torch.ones(()))
    return norm(x, w, "norm")[len(registers) :]


def norm(x: Tensor, w: dict[str, Tensor], name: str) -> Tensor:
    centred = x - x.mean(1, keepdim=True)
    variance = centred.square().mean(1, keepdim=True)
    return centred / (variance + 1e-6).sqrt() * w[f"{name}.weight"] + w[f"{name}.bias"]
