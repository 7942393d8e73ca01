"""How hard something presses and pulls on a fingertip, from its gel's depth and its markers."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from touchgoal.control.tactile.sensor_models import SensorModel

# A gel bulges around what presses into it: only what lies deeper than this share of the deepest point
# counts. With it simulated balls of 3 to 25 mm at 0.5 to 15 N come out within 6 %.
_CONTACT_SHARE = 0.35


@dataclass(frozen=True)
class TouchForce:
    """Force of an object on a sensor.

    Attributes:
        normal: N, positive when pressed.
        shear: N along the sensor's x and y; None without markers.
    """

    normal: float
    shear: tuple[float, float] | None


def estimate_force(
    depth: Float32[np.ndarray, "h w"],
    pixel_pitch: float,
    sensor: SensorModel,
    markers: Float32[np.ndarray, "*n 2"] | None = None,
    displacement: Float32[np.ndarray, "*n 2"] | None = None,
) -> TouchForce:
    """Resultant force from one frame's depth and its markers' displacement.

    Normal: the gel as an elastic foundation, `foundation_modulus` times the volume in contact.
    Flat faces and edges come out too strong, for the gel bulges beside them; of a contact that reaches beyond the view only the part in view counts. On a
    real sensor it holds as far as the modulus does: compare with one known weight.

    Shear: `shear_stiffness` times the mean displacement of the markers, each counting as much as
    the gel is deep there. Edges, which few markers feel, are the least certain.

    Args:
        depth: of the gel's surface, m (`depth.DepthEstimator`).
        pixel_pitch: m per px.
        sensor: its stiffnesses.
        markers: (x, y) of the dots, px (`MarkerTracker.now.positions`).
        displacement: how far they are from their rest, px (`MarkerTracker.displacement`).
    """
    contact = np.where(depth > _CONTACT_SHARE * max(float(depth.max()), 0.0), depth, 0)
    normal = sensor.foundation_modulus * float(contact.sum()) * pixel_pitch**2
    if markers is None or displacement is None:
        return TouchForce(normal, None)
    at = np.rint(markers.reshape(-1, 2)).astype(int)
    column, row = np.clip(at, 0, np.array(depth.shape[::-1]) - 1).T
    weight = contact[row, column].astype(np.float64)
    moved = weight @ displacement.reshape(-1, 2) / max(float(weight.sum()), 1e-12)
    x, y = sensor.shear_stiffness * pixel_pitch * moved
    return TouchForce(normal, (float(x), float(y)))
