"""Arrays of fingertip sensors: images (RGB, rows by columns), and maps of a gel."""

import numpy as np
from jaxtyping import Float, Float32, UInt8

Image = UInt8[np.ndarray, "h w 3"]
Images = UInt8[np.ndarray, "n h w 3"]
Counts = Float32[np.ndarray, "h w 3"]  # an image that is not rounded, counts of 0 to 255
AnyImage = Image | Counts
Map = Float32[np.ndarray, "h w"]  # map of a gel, such as its surface (m into the gel)
Circle = Float[np.ndarray, " 3"]
"""Centre x (column), centre y (row) and radius of a contact, px; (0, 0) is the first pixel."""
Circles = Float[np.ndarray, "n 3"]
