"""Sensor file computed from a ring of three lamps and a matt gel, for sensors without presses.

`touchgoal calibrate` fits a real one.
"""

from dataclasses import dataclass

import numpy as np

from touchgoal.control.tactile.sensor_calibration import N_FEATURES, SensorCalibration
from touchgoal.control.tactile.sensor_models import SensorModel


@dataclass(frozen=True)
class LedRing:
    """Ring of three lamps, red, green and blue, around the camera's view."""

    azimuths: tuple[float, float, float]  # of the lamps, degrees from x (right) towards y (down)
    # radius, distance: of the ring, and of its plane from the gel's surface, m
    radius: float
    distance: float
    brightness: float = 110.0  # mean of the untouched picture, counts
    shadowed: float = 0.5  # share of a lamp's light missing in its full shadow; the rest scatters


# As real Wedges light their gel (EstimateModulus' pictures, rectified): red from below, green from
# the left, blue from above, each flank of a ball's imprint in the colour of the side that it faces.
# Distances: the best of a few on one grasp of a golf ball, of whose change they leave 26 %
# unexplained (`touchgoal check-sensor`). Three other grasps: 34 % (same sensor), 51 and 61 %
# (another session).
WEDGE_RING = LedRing(azimuths=(90.0, 180.0, -90.0), radius=30e-3, distance=50e-3)


def from_led_ring(sensor: SensorModel, ring: LedRing) -> SensorCalibration:
    """Return a sensor file by Lambert's law with the inverse square of the distance.

    A lamp in direction l lights a surface of normal n by n.l: linear in the normal's image-plane
    part, and falling with its square, n_z = sqrt(1 - nx^2 - ny^2). How l changes over the image
    enters the terms in u and v.
    """
    rows, columns = sensor.image_shape
    u, v = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows))
    x, y = u * (columns - 1) / 2 * sensor.pixel_pitch, v * (rows - 1) / 2 * sensor.pixel_pitch
    place = np.stack([np.ones_like(u), u, v], -1).reshape(-1, 3)
    background = np.empty((rows, columns, 3))
    response = np.zeros((3, N_FEATURES, 3), np.float32)
    for channel, azimuth in enumerate(np.radians(ring.azimuths)):
        lx, ly = ring.radius * np.cos(azimuth) - x, ring.radius * np.sin(azimuth) - y
        light = (lx**2 + ly**2 + ring.distance**2) ** -1.5
        background[..., channel] = ring.brightness * light / light.mean()
        slopes = np.stack([lx, ly], -1).reshape(-1, 2) / ring.distance
        # Coefficients of (1, u, v), one row per slope.
        response[channel, :2] = ring.brightness * np.linalg.lstsq(place, slopes, rcond=None)[0].T
        response[channel, [2, 4], 0] = -ring.brightness / 2
    elevation = ring.distance / ring.radius
    return SensorCalibration(
        sensor=sensor.name,
        background=np.clip(background, 0, 255).astype(np.uint8),
        pixel_pitch=sensor.pixel_pitch,
        response=response,
        light_azimuths=ring.azimuths,
        shadow_slope=elevation,
        shadow=np.diag(np.full(3, -ring.shadowed * ring.brightness)).astype(np.float32),
        penumbra=5e-5,
        max_slope=float(np.sin(np.arctan(elevation))),  # steeper walls turn away
        max_depth=1e-3,
        blur_sigmas=(1.05e-3, 0.525e-3, 0.2625e-3, 0.1225e-3),  # as fitted to the Mini's gel
        noise=0.97,
    )
