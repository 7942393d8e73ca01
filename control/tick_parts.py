"""Images and curves of one tick, for a viewer."""

from collections.abc import Mapping

import numpy as np

from touchgoal.control import features as ft


def parts_of(tick: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Return images "IMAGE" and scalars "PLOT/CURVE" of an observation.

    Cost, progress and action are among the scalars where the tick has them.
    """
    images = {
        key.removeprefix(ft.IMAGE_PREFIX): value
        for key, value in tick.items()
        if key.startswith(ft.IMAGE_PREFIX)
    }
    curves: dict[str, float] = {}
    for key, label in ((ft.COST, "cost"), (ft.TRUTH_PROGRESS, "progress")):
        if key in tick:
            curves[f"{label}/{label}"] = tick[key][0]
    curves["force (N)/force"] = float(np.linalg.norm(tick[ft.WRENCH][:3]))
    curves["gripper width (mm)/measured"] = 1e3 * tick[ft.STATE][-1]
    if ft.ACTION in tick:
        *changes, width = tick[ft.ACTION]
        curves["gripper width (mm)/commanded"] = 1e3 * width
        curves |= {f"joint change (rad)/joint_{i}": c for i, c in enumerate(changes, 1)}
    return images, {path: float(value) for path, value in curves.items()}
