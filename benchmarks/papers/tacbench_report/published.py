"""The paper's figures on real sensors: Tables 5 to 9 of Sparsh."""

from dataclasses import dataclass

SHARES = (1.0, 1 / 3, 0.1, 0.01)  # shares of the labels


@dataclass(frozen=True)
class Published:
    """A table: each encoder's measure at every share of the labels."""

    task: str
    sensor: str
    measure: str
    digits: int
    values: dict[str, tuple[float, float, float, float]]


# The paper's "RMSE" of the force is a mean absolute error over the axes (its code); its slip and
# pose tables are a DIGIT's, its grasp table is of two GelSights with dots.
_FORCE = "MAE, there called RMSE, mN"
PAPER = (
    Published("force", "gelsight_mini", _FORCE, 0, {
        "E2E": (57.21, 59.09, 57.43, 82.42),
        "Sparsh (MAE)": (22.72, 23.28, 33.56, 78.98),
        "Sparsh (DINO)": (20.25, 23.79, 32.17, 53.43),
        "Sparsh (IJEPA)": (27.91, 35.20, 44.93, 91.81),
        "Sparsh (VJEPA)": (33.26, 34.07, 42.35, 80.36),
    }),
    Published("force", "digit", _FORCE, 0, {
        "E2E": (39.34, 61.42, 98.22, 187.51),
        "Sparsh (MAE)": (36.61, 45.96, 58.55, 115.39),
        "Sparsh (DINO)": (36.09, 44.03, 51.89, 97.95),
        "Sparsh (IJEPA)": (40.27, 60.04, 86.57, 130.37),
        "Sparsh (VJEPA)": (39.38, 56.34, 76.11, 130.83),
    }),
    Published("slip", "digit", "F1", 3, {
        "E2E": (0.767, 0.238, 0.299, 0.214),
        "Sparsh (MAE)": (0.783, 0.818, 0.691, 0.269),
        "Sparsh (DINO)": (0.685, 0.561, 0.548, 0.489),
        "Sparsh (IJEPA)": (0.776, 0.791, 0.775, 0.726),
        "Sparsh (VJEPA)": (0.820, 0.828, 0.800, 0.760),
    }),
    Published("pose", "digit", "accuracy", 3, {
        "E2E": (0.812, 0.245, 0.162, 0.162),
        "Sparsh (MAE)": (0.896, 0.719, 0.417, 0.223),
        "Sparsh (DINO)": (0.913, 0.834, 0.460, 0.242),
        "Sparsh (IJEPA)": (0.851, 0.601, 0.323, 0.212),
        "Sparsh (VJEPA)": (0.856, 0.648, 0.368, 0.228),
    }),
    Published("grasp", "gelsight", "accuracy", 3, {
        "E2E": (0.784, 0.725, 0.682, 0.478),
        "Sparsh (MAE)": (0.815, 0.696, 0.764, 0.466),
        "Sparsh (DINO)": (0.780, 0.706, 0.773, 0.473),
        "Sparsh (IJEPA)": (0.802, 0.782, 0.768, 0.598),
        "Sparsh (VJEPA)": (0.809, 0.702, 0.743, 0.523),
    }),
)  # fmt: skip
# Table 11, "Best SSL vs E2E" in %; the paper does not give its shares of labels.
BEST_AGAINST_END_TO_END = {"force": 59.74, "slip": 242.70, "pose": 235.89, "grasp": 5.14}


def published(task: str, sensor: str) -> Published | None:
    """Return a task's table of this sensor, or else its only table."""
    kind = sensor.removesuffix("_markers")
    own = [t for t in PAPER if t.task == task and t.sensor == kind]
    others = [t for t in PAPER if t.task == task]
    return own[0] if own else others[0] if len(others) == 1 else None
