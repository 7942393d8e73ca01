"""Tactile images in torch: batched, on any device, differentiable in the object's height.

Follows `control.tactile.gel.deform` and `optics.render` without noise and markers;
`tests/test_tactile.py` compares both.
"""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from touchgoal.control.tactile.gel import CONTACT_SHARE, NEARBY_CELLS, SHADOW_CELLS, pixels_per_cell
from touchgoal.control.tactile.sensor_calibration import SensorCalibration
from touchgoal.sim_envs.tactile.sensor_instance import COUNT_STEP, SensorInstance

Fields = Float[Tensor, "b h w"]


def deform(overlap: Fields, pitch: float, blur_sigmas: tuple[float, ...]) -> Fields:
    """Deform gels under objects' overlaps (m), as `gel.deform`."""
    scale = pixels_per_cell(pitch)
    low = F.avg_pool2d(overlap, scale)
    around = 2 * NEARBY_CELLS + 1
    contact = low > CONTACT_SHARE * F.max_pool2d(low, around, stride=1, padding=NEARBY_CELLS)
    smooth = low
    for sigma in blur_sigmas:
        smooth = torch.where(contact, low, _blur(smooth, _gaussian(sigma / (pitch * scale), low)))
    smooth = _blur(smooth, _binomial(5, low))
    soft = _blur(contact.to(low), _binomial(5, low))
    smooth, low, soft = (_resize(a, *overlap.shape[1:]) for a in (smooth, low, soft))
    return _blur(smooth + soft * (overlap - low), _binomial(3, low))


def colour_change(surface: Fields, instance: SensorInstance) -> Float[Tensor, "b 3 h w"]:
    """Return the colours (counts) that surfaces add to the untouched image, half size."""
    calibration, pitch = instance.calibration, 2 * instance.pixel_pitch
    illumination, response, shadow = (
        torch.as_tensor(a, dtype=surface.dtype, device=surface.device)
        for a in (instance.illumination, calibration.response, calibration.shadow)
    )
    _, h, w = surface.shape
    u = (4 * torch.arange(w).to(surface) + 1) / (2 * w - 1) - 1
    v = ((4 * torch.arange(h).to(surface) + 1) / (2 * h - 1) - 1)[:, None]
    known = surface.clamp(max=calibration.max_depth)
    shadows = shadow_depth(known, pitch, calibration.light_azimuths, calibration.shadow_slope)
    shadows = shadows / (shadows + calibration.penumbra)
    at_rest, along_u, along_v = torch.einsum(
        "bkhw,ckm->mbchw", _features(surface, pitch, calibration), response
    )
    lit = at_rest + u * along_u + v * along_v
    return illumination * (lit + torch.einsum("blhw,cl->bchw", shadows, shadow))


def render(overlap: Fields, instance: SensorInstance) -> Float[Tensor, "b 3 h2 w2"]:
    """Render noise-free RGB images (counts) of overlaps (m) at half the images' resolution."""
    surface = deform(overlap, 2 * instance.pixel_pitch, instance.calibration.blur_sigmas)
    background = COUNT_STEP * torch.as_tensor(instance.background).to(overlap)
    change = F.interpolate(colour_change(surface, instance), scale_factor=2, mode="bilinear")
    return (background + change).clamp(0, 255)


def shadow_depth(
    surface: Fields, pitch: float, azimuths: tuple[float, ...], slope: float
) -> Float[Tensor, "b lights h w"]:
    """Return each point's depth (m) below each light's shadow line, as `gel.shadow_depth`."""
    scale = pixels_per_cell(pitch)
    low = F.avg_pool2d(surface, scale)
    third = torch.full((1, 3), 1 / 3).to(surface)[0]
    depths = []
    for azimuth in azimuths:
        cos, sin = math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))
        ridge = low
        for n in range(1, SHADOW_CELLS + 1):
            dx, dy = round(n * cos), round(n * sin)
            drop = slope * pitch * scale * (dx * cos + dy * sin)
            ridge = torch.maximum(ridge, _shifted(low, dx, dy) - drop)
        depths.append(_resize(_blur(ridge - low, third), *surface.shape[1:]))
    return torch.stack(depths, 1)


def _features(
    surface: Fields, pitch: float, calibration: SensorCalibration
) -> Float[Tensor, "b 10 h w"]:
    padded = F.pad(surface[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    gx = (padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2]) * (0.5 / pitch)
    gy = (padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1]) * (0.5 / pitch)
    square = gx * gx + gy * gy
    inverse = -torch.rsqrt(torch.maximum(1 + square, square / calibration.max_slope**2))
    x, y = gx * inverse, gy * inverse
    xx, xy, yy = x * x, x * y, y * y
    depth = surface.clamp(max=calibration.max_depth)
    return torch.stack([x, y, xx, xy, yy, xx * x, xx * y, x * yy, yy * y, depth], 1)


def _shifted(field: Fields, dx: int, dy: int) -> Fields:
    _, h, w = field.shape
    padded = F.pad(field, (max(-dx, 0), max(dx, 0), max(-dy, 0), max(dy, 0)), value=-1.0)
    top, left = max(dy, 0), max(dx, 0)
    return padded[:, top : top + h, left : left + w]


def _resize(field: Fields, rows: int, columns: int) -> Float[Tensor, "b rows columns"]:
    return F.interpolate(field[:, None], (rows, columns), mode="bilinear")[:, 0]


def _blur(field: Fields, kernel: Float[Tensor, " k"]) -> Fields:
    """Blur separably, mirrored at the border without repeating its pixels (OpenCV's default)."""
    r = len(kernel) // 2
    padded = F.pad(field[:, None], (r, r, r, r), mode="reflect")
    return F.conv2d(F.conv2d(padded, kernel[None, None, None]), kernel[None, None, :, None])[:, 0]


def _gaussian(sigma: float, like: Tensor) -> Float[Tensor, " k"]:
    """Return OpenCV's kernel for float images: four standard deviations to each side."""
    size = round(sigma * 8 + 1) | 1
    x = torch.arange(size).to(like) - size // 2
    kernel = torch.exp(-0.5 * (x / sigma) ** 2)
    return kernel / kernel.sum()


def _binomial(size: int, like: Tensor) -> Float[Tensor, " k"]:
    """Return OpenCV's kernel of a small size without a standard deviation."""
    row = [math.comb(size - 1, k) / 2 ** (size - 1) for k in range(size)]
    return torch.tensor(row, dtype=like.dtype, device=like.device)
