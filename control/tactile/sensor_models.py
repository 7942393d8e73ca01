"""Fingertip sensors as data: dimensions, stiffness and optics with unit and source."""

from dataclasses import dataclass, replace
from pathlib import Path

from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.runtime.errors import UserError, unknown_name


@dataclass(frozen=True)
class MarkerGrid:
    """Dots printed on a gel, centred on the image: pitch between neighbours and diameter, m."""

    rows: int
    columns: int
    pitch: float
    diameter: float


@dataclass(frozen=True)
class SensorModel:
    """Camera-based fingertip sensor.

    The sensor frame sits on the undeformed gel, in the middle of the image: x along the image's
    columns, y along its rows (downwards), z out of the gel. The gel is modelled as flat.
    """

    name: str  # id that encoders and preprocessors use
    image_shape: tuple[int, int]  # (rows, columns) of a frame
    pixel_pitch: float  # m of gel per pixel; square pixels
    pitch_range: tuple[float, float]  # (least, most) among sensors of this model, m per pixel
    gel_size: tuple[float, float]  # (along x, along y) of the gel, m
    gel_thickness: float  # m
    case_size: tuple[float, float, float]  # (along x, along y, depth) of the housing, m
    foundation_modulus: float  # gel pressure per indentation, Pa/m, as the camera shows it
    shear_modulus: float  # of the gel's material, Pa
    normal_stiffness: float  # of the whole gel under a typical curved contact, N/m
    shear_stiffness: float  # of the whole gel, N/m
    frame_rate: float  # Hz
    sensor_file: Path  # folder with the calibration of a typical sensor (`sensor_calibration`)
    markers: MarkerGrid | None = None  # dots printed on the gel, if any
    defocus: float = 0.0  # standard deviation of the camera's largest blur by its lens, px
    measured: bool = True  # whether the sensor file was fitted to presses, not computed

    @property
    def images_only(self) -> str:
        """Why no depths and forces are read from its images, and what to do; "" if they are."""
        if self.measured:
            return ""
        return (
            f"the sensor file of {self.name} is computed, not fitted to presses: images and contact are "
            "read, no millimetres and newtons; calibrate this sensor (touchgoal record-presses)"
        )


_FILES = Path(__file__).parent / "sensor_files"

# Image: the SDK's 320x240 crop. Sensor file and 0.0634 mm/px: one unit fitted to 46 presses of two
# balls of known radius (GelSLAM), so depths in millimetres hold on it. Other sources range from
# 0.058 (the datasheet's 18.6 x 14.3 mm) to 0.071 (22.9 x 17.1): calibrate your own. Gel 25.4 x 20.9
# x 4.0 mm: FEATS STEP file. Case 32.5 x 28.5 x 28.3 mm: GelSight STEP file. Shear modulus: FEATS'
# Neo-Hooke fit, 2 C10 = 0.145 MPa. Foundation modulus: a bonded, nearly incompressible 4 mm layer
# of E = 0.44 MPa (the same fit) is about three times stiffer than E/t; 3e8 Pa/m gives 0.8 mm under
# a 25 mm ball at 15 N, within FEATS' measured range (up to 0.86 mm). Whole-gel stiffness: the same
# modulus over the patch of such a ball, and G A / t of the gel.
GELSIGHT_MINI = SensorModel(
    name="gelsight_mini",
    image_shape=(240, 320),
    pixel_pitch=0.0634e-3,
    pitch_range=(0.058e-3, 0.071e-3),
    gel_size=(25.4e-3, 20.9e-3),
    gel_thickness=4.0e-3,
    case_size=(32.5e-3, 28.5e-3, 28.3e-3),
    foundation_modulus=3.0e8,
    shear_modulus=1.45e5,
    normal_stiffness=2.0e4,
    shear_stiffness=6.0e3,
    frame_rate=25.0,
    sensor_file=_FILES / "gelsight_mini",
)

# 63 dots found in three real images: pitch 31.4-32.5 px, diameter 14-18 px of 320, round figures
# in millimetres at the scale above.
GELSIGHT_MINI_MARKERS = replace(
    GELSIGHT_MINI,
    name="gelsight_mini_markers",
    markers=MarkerGrid(rows=7, columns=9, pitch=2.0e-3, diameter=1.0e-3),
)

# The bench sensor of the Taxim paper: 0.0295 mm/px at 640x480, here at half of that. Its gel's
# moduli are not published: the Mini's, whose silicone is the same maker's.
# Dots 11 x 9, pitch 29 x 26 px of 320x240 at 0.051 mm/px: FOTS' GelSight; mean pitch, diameter
# by analogy to the Mini's.
GELSIGHT = replace(
    GELSIGHT_MINI,
    name="gelsight",
    pixel_pitch=0.059e-3,
    pitch_range=(0.051e-3, 0.063e-3),
    gel_size=(25.0e-3, 25.0e-3),
    sensor_file=_FILES / "gelsight",
)
GELSIGHT_MARKERS = replace(
    GELSIGHT,
    name="gelsight_markers",
    markers=MarkerGrid(rows=9, columns=11, pitch=1.4e-3, diameter=0.7e-3),
)

# Image: QVGA at 60 Hz, upright as digit-interface returns it. Sensor file: one unit fitted to 20
# presses of one ball (FOTS); ball (3 mm) and scale are assumed, because no source states them and
# images do not show them. Sources range from 0.0405 (gs_sdk, at VGA) over 0.0511 (FOTS) to 0.0667
# (a 16 x 19 mm sensing field). Case 32.3 x 27 x 34 mm: its STL. Gel 20 x 30 mm: TACTO, which also
# bends it by 5 mm (R 100 mm); flat here. Thickness and moduli are not published: a third thinner
# than the Mini's, of the same silicone. Its lens turns in a thread: FOTS' unit is in focus, that of
# visuo-tactile-clustering is blurred by about 4 px.
DIGIT = SensorModel(
    name="digit",
    image_shape=(320, 240),
    pixel_pitch=0.047e-3,
    pitch_range=(0.0405e-3, 0.0667e-3),
    gel_size=(20.0e-3, 30.0e-3),
    gel_thickness=2.7e-3,
    case_size=(27.0e-3, 32.3e-3, 34.0e-3),
    foundation_modulus=4.5e8,
    shear_modulus=1.45e5,
    normal_stiffness=3.0e4,
    shear_stiffness=9.0e3,
    frame_rate=60.0,
    sensor_file=_FILES / "digit",
    defocus=5.0,
)

# A finger whose camera sees the gel at an angle (Wang et al. 2021, arXiv 2106.08851); its image
# is that between the gel's corners, which differ from unit to unit. Scale: a round number that may
# be a tenth too small. With it, golf ball dimples in EstimateModulus' images are 3.9 mm apart;
# 300 to 400 dimples on a ball would be 4.1 to 4.7 mm apart. Frame rate: that of these images.
# Gel: as large as the image; case: a margin around it. Thickness and moduli were not found: the
# Mini's. Sensor file: computed from lamp positions, because no images of rigid
# balls may be shipped; real presses have twice its contrast.
GELSIGHT_WEDGE = replace(
    GELSIGHT_MINI,
    name="gelsight_wedge",
    pixel_pitch=0.1e-3,
    pitch_range=(0.09e-3, 0.12e-3),
    gel_size=(32.0e-3, 24.0e-3),
    case_size=(36.0e-3, 28.0e-3, 28.3e-3),
    frame_rate=30.0,
    sensor_file=_FILES / "gelsight_wedge",
    measured=False,
)

_ALL = GELSIGHT_MINI, GELSIGHT_MINI_MARKERS, GELSIGHT, GELSIGHT_MARKERS, DIGIT, GELSIGHT_WEDGE
SENSORS = {sensor.name: sensor for sensor in _ALL}


def find_model(name: str) -> SensorModel:
    """Return a sensor model by name; UserError if there is none."""
    if name not in SENSORS:
        raise unknown_name("sensor", name, SENSORS)
    return SENSORS[name]


def find_sensor(name: str) -> SensorModel:
    """Return a sensor by model name, or by the folder of its sensor file; UserError if neither."""
    if name in SENSORS:
        return SENSORS[name]
    folder = Path(name)
    if not folder.is_dir():
        raise unknown_name("sensor or folder of a sensor file", name, SENSORS)
    own = load(folder)
    if own.sensor not in SENSORS:
        raise UserError(f"{folder} is of an unknown sensor, {own.sensor}")
    pitch, shape = own.pixel_pitch, own.background.shape[:2]
    return replace(
        SENSORS[own.sensor],
        image_shape=shape,
        pixel_pitch=pitch,
        pitch_range=(pitch, pitch),
        sensor_file=folder,
        measured=True,
    )
