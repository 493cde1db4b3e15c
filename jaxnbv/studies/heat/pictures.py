"""The temperature of the clouds, and where they say that it is coldest."""

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize

from jaxnbv.studies.engine.measures import Record
from jaxnbv.studies.engine.pictures import Tiles, across, draw_on, say, still_of
from jaxnbv.studies.heat.study import HeatStudy, heat_problem
from jaxnbv.tasks import body_temperature
from jaxnbv.viz.render import Still

# Without its palest colours, which would not stand out against the grey of what was not scanned.
_HEAT = LinearSegmentedColormap.from_list("heat", mpl.colormaps["inferno"](np.linspace(0.0, 0.9, 256)))
_MARKS: dict[str, dict[str, Any]] = {
    "heat source": {"marker": "X", "color": "#d55e00", "ms": 6.0, "mec": "white"},
    "coldest point of the object": {"marker": "*", "color": "#009e73", "ms": 10.0, "mec": "white"},
    "coldest point of the cloud": {"marker": "o", "color": "#0072b2", "ms": 5.5, "mec": "white"},
}


def tiles(study: HeatStudy, record: Record, methods: Sequence[str], pixels: int) -> Tiles:
    """The points of the cloud that can be seen, coloured by temperature, over the grey of the object; its coldest
    point, and the estimate."""
    scene, held = study.scene(record["scene"]), record["methods"]
    truth, heat = study.truth(scene), heat_problem(scene)
    still = still_of(truth.mesh, across(study, record), pixels)
    colours = ScalarMappable(Normalize(0.0, float(truth.temperatures.max())), _HEAT)
    seen = {method: study.seen(scene, held[method]) for method in methods}

    def draw_truth(axes: Axes) -> None:
        draw_on(axes, still, truth.points, colours.to_rgba(truth.temperatures))
        _mark(axes, still, np.asarray(heat.source, np.float64), "heat source")
        _mark(axes, still, truth.coldest, "coldest point of the object")

    def tile(axes: Axes, method: str, view: int) -> None:
        points, temperature = body_temperature(seen[method][view][1].cloud, heat)
        draw_on(axes, still, points, colours.to_rgba(temperature.values))
        estimate = held[method]["estimates"]["all"]
        _mark(axes, still, truth.coldest, "coldest point of the object")
        _mark(axes, still, np.array(estimate["points"][view]), "coldest point of the cloud")
        say(axes, f"{estimate['distances'][view]:.2f}")

    caption = "Scanned points, coloured by the temperature that they give. Beneath: how far the estimate is off."
    return Tiles(caption, tile, draw_truth, marks=_MARKS, scale=(colours, "temperature (degrees)"))


def _mark(axes: Axes, still: Still, point: Float[np.ndarray, "3"], name: str) -> None:
    """Hollow if the object hides it."""
    pixels, in_front = still.project(point[None])
    look = _MARKS[name] if in_front[0] else _MARKS[name] | {"mfc": "white", "mec": _MARKS[name]["color"]}
    axes.plot(pixels[0, 0], pixels[0, 1], zorder=6, **look)
