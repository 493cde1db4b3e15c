"""The heat study's qualitative figure: the temperature of the clouds, and where they say that it is coldest."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize

from jaxnbv.studies.engine.measures import Record, methods_of
from jaxnbv.studies.engine.pictures import Grid, draw_on, first_scenes, places, shows_from, still_of, write_grids
from jaxnbv.studies.heat.study import HeatStudy, Truth, heat_problem
from jaxnbv.tasks import body_temperature
from jaxnbv.viz.render import Still

_SHOWN = ("heat", "heat-reached", "farthest", "uncertainty", "random")
# Without its palest colours, which would not stand out against the grey of what was not scanned.
_HEAT = LinearSegmentedColormap.from_list("heat", mpl.colormaps["inferno"](np.linspace(0.0, 0.9, 256)))
_MARKS: dict[str, dict[str, Any]] = {
    "heat source": {"marker": "X", "color": "#d55e00", "ms": 6.0, "mec": "white"},
    "coldest point of the object": {"marker": "*", "color": "#009e73", "ms": 10.0, "mec": "white"},
    "coldest point of the cloud": {"marker": "o", "color": "#0072b2", "ms": 5.5, "mec": "white"},
}


def write_pictures(
    records: Sequence[Record], study: HeatStudy, folder: str | Path, scenes: int = 4, pixels: int = 420
) -> list[Path]:
    """Write `heat_<scene>.png` for the first scenes, not picked ones; return the paths.

    First the object's own temperature; a row a method, a column a number of views: the points of the cloud that can be
    seen, coloured by temperature, over the grey of the object; its coldest point, and the estimate. Methods are the two
    that seek cold by full search and the baselines, those of them that the records hold, else all that they do. Views
    are scanned again as they were.

    - `pixels`: along a side of a picture.

    **Raises:** `ValueError` if there are no records, or no method that all of them hold.
    """
    methods = methods_of(records, study.methods, _SHOWN)
    return write_grids(first_scenes(records, scenes), folder, "heat", lambda one: _clouds(one, study, methods, pixels))


def _clouds(record: Record, study: HeatStudy, methods: Sequence[str], pixels: int) -> Grid:
    scene = study.scene(record["scene"])
    truth, heat = study.truth(scene), heat_problem(scene)
    source = np.asarray(heat.source, np.float64)
    still = still_of(truth.mesh, _eye(truth, source), pixels)
    colours = ScalarMappable(Normalize(0.0, float(truth.temperatures.max())), _HEAT)
    runs = [record["methods"][method] for method in methods]
    seen = [study.seen(scene, run) for run in runs]
    views = len(runs[0]["views"])
    counts = sorted({math.ceil(views / 3), math.ceil(2 * views / 3), views})

    def draw(axes: Axes, row: int, column: int) -> None:
        if column == 0 and row > 0:
            axes.axis("off")
        elif column == 0:
            draw_on(axes, still, truth.points, colours.to_rgba(truth.temperatures))
            _mark(axes, still, source, "heat source")
            _mark(axes, still, truth.coldest, "coldest point of the object")
        else:
            count = counts[column - 1]
            points, temperature = body_temperature(seen[row][count - 1][1].cloud, heat)
            draw_on(axes, still, points, colours.to_rgba(temperature.values))
            estimate: dict[str, Any] = runs[row]["estimates"]["all"]
            _mark(axes, still, truth.coldest, "coldest point of the object")
            _mark(axes, still, np.array(estimate["points"][count - 1]), "coldest point of the cloud")
            axes.set_xlabel(f"{estimate['distances'][count - 1]:.2f}", fontsize=8)

    caption = "Scanned points, coloured by the temperature that they give. Beneath: how far the estimate is off."
    columns = ["the object", *(f"after {count} views" for count in counts)]
    title, scale = f"Scene {record['scene']}: {record['name']}", (colours, "temperature (degrees)")
    return Grid(title, caption, methods, columns, draw, _MARKS, scale, named=1)


def _mark(axes: Axes, still: Still, point: Float[np.ndarray, "3"], name: str) -> None:
    """Hollow if the object hides it."""
    pixels, in_front = still.project(point[None])
    look = _MARKS[name] if in_front[0] else _MARKS[name] | {"mfc": "white", "mec": _MARKS[name]["color"]}
    axes.plot(pixels[0, 0], pixels[0, 1], zorder=6, **look)


def _eye(truth: Truth, source: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """A place from which the coldest point shows, if there is one the source too, and a little above."""
    eyes = places()
    coldest, heated = shows_from(truth.mesh, eyes, np.stack([truth.coldest, source])).T
    height = eyes[:, 1] / np.linalg.norm(eyes, axis=1)
    return eyes[np.argmax(4.0 * coldest + 1.0 * heated - np.abs(height - 0.35))]
