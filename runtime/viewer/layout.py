"""Layout of the rerun viewer: images on the left, plots on the right, one time axis for all."""

from collections.abc import Collection
from itertools import cycle
from typing import Any

_LEGEND = 5  # curves whose names fit into a plot's corner
# RGBA; Okabe and Ito, "Color universal design" (2008), without black
_COLORS = (0xE69F00FF, 0x56B4E9FF, 0x009E73FF, 0xF0E442FF, 0x0072B2FF, 0xD55E00FF, 0xCC79A7FF)


def lay_out(images: Collection[str], scalars: Collection[str], timeline: str) -> Any:
    """Return a `rerun.blueprint.Blueprint` with a tab for each trajectory.

    Args:
        images: paths "TRAJECTORY/IMAGE".
        scalars: paths "TRAJECTORY/PLOT/CURVE".
        timeline: name of the timeline that the viewer moves along.
    """
    import rerun.blueprint as views  # pyright: ignore[reportMissingImports]

    names = dict.fromkeys(path.split("/")[0] for path in (*images, *scalars))
    tabs = [_tab(name, _under(name, images), _under(name, scalars)) for name in names]
    time = views.TimePanel(timeline=timeline, state="collapsed")
    return views.Blueprint(views.Tabs(*tabs), time, collapse_panels=True)


def _under(name: str, paths: Collection[str]) -> list[str]:
    return [path for path in paths if path.startswith(f"{name}/")]


def _tab(name: str, images: list[str], scalars: list[str]) -> Any:
    import rerun.blueprint as views  # pyright: ignore[reportMissingImports]

    # pairs from the end: the fingertips come last, and stand side by side
    ends = range(len(images), 0, -2)
    rows = [views.Horizontal(*map(_image, images[max(0, end - 2) : end])) for end in ends]
    plots: dict[str, list[str]] = {}
    for path in scalars:
        plots.setdefault(path.rpartition("/")[0], []).append(path)
    curves = views.Vertical(*(_plot(plot, paths) for plot, paths in plots.items()))
    return views.Horizontal(views.Vertical(*reversed(rows)), curves, name=name)


def _image(path: str) -> Any:
    import rerun.blueprint as views  # pyright: ignore[reportMissingImports]

    return views.Spatial2DView(origin=_entity(path), name=path.rpartition("/")[2])


def _plot(plot: str, curves: list[str]) -> Any:
    import rerun  # pyright: ignore[reportMissingImports]
    import rerun.blueprint as views  # pyright: ignore[reportMissingImports]

    return views.TimeSeriesView(
        origin=_entity(plot),
        name=plot.rpartition("/")[2],
        overrides={
            _entity(curve): rerun.SeriesLines.from_fields(colors=color)
            for curve, color in zip(curves, cycle(_COLORS), strict=False)
        },
        axis_x=views.TimeAxis(link=views.components.LinkAxis.LinkToGlobal),
        plot_legend=views.PlotLegend(visible=1 < len(curves) <= _LEGEND),
    )


def _entity(path: str) -> str:
    import rerun  # pyright: ignore[reportMissingImports]

    return "/" + rerun.new_entity_path(path.split("/"))
