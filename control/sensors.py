"""Fingertip sensors as data: what a GelSight is, in numbers with unit and source."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SensorModel:
    """A camera-based fingertip sensor.

    The sensor frame sits on the undeformed gel, in the middle of the image: x along the image's
    columns, y along its rows (downwards), z out of the gel.

    Attributes:
        name: the id under which encoders and preprocessors know the sensor.
        image_shape: (rows, columns) of a frame.
        pixel_pitch: m of gel per pixel; square pixels.
        gel_size: (along x, along y) of the gel, m.
        gel_thickness: m.
        case_size: (along x, along y, depth) of the housing, m.
        foundation_modulus: gel pressure per indentation, Pa/m: how the gel's surface gives way
            under a contact, as the camera sees it.
        normal_stiffness: of the gel as a whole under a typical curved contact, N/m.
        shear_stiffness: of the gel as a whole, N/m.
        frame_rate: Hz.
    """

    name: str
    image_shape: tuple[int, int]
    pixel_pitch: float
    gel_size: tuple[float, float]
    gel_thickness: float
    case_size: tuple[float, float, float]
    foundation_modulus: float
    normal_stiffness: float
    shear_stiffness: float
    frame_rate: float


# Image: the SDK's 320x240 crop; 0.059 mm/px is Tactile-MNIST's 18.88 x 14.16 mm (the datasheet says
# 18.6 x 14.3; other sources up to 22.9 x 17.1: treat the pitch as a calibration parameter).
# Gel 25.4 x 20.9 x 4.0 mm: FEATS STEP file. Case 32.5 x 28.5 x 28.3 mm: GelSight STEP file.
# Foundation modulus: a bonded, nearly incompressible 4 mm layer of E = 0.44 MPa (FEATS' Neo-Hooke
# fit) is about three times stiffer than E/t; 3e8 Pa/m gives 0.8 mm under a 25 mm ball at 15 N,
# within FEATS' measured range (up to 0.86 mm). Not fitted to one unit: `touchgoal calibrate` is.
# Whole-gel stiffness: the same modulus over the patch of such a ball, and G A / t of the gel.
GELSIGHT_MINI = SensorModel(
    name="gelsight_mini",
    image_shape=(240, 320),
    pixel_pitch=0.059e-3,
    gel_size=(25.4e-3, 20.9e-3),
    gel_thickness=4.0e-3,
    case_size=(32.5e-3, 28.5e-3, 28.3e-3),
    foundation_modulus=3.0e8,
    normal_stiffness=2.0e4,
    shear_stiffness=6.0e3,
    frame_rate=25.0,
)
