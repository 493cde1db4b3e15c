"""The part study's qualitative figure: the parts that have been found, view by view and method by method."""

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.scanning import TriangleMesh
from jaxnbv.scanning.metrics import true_mesh
from jaxnbv.studies.engine.measures import Record, methods_of
from jaxnbv.studies.engine.pictures import Grid, draw_on, places, shows_from, still_of, write_grids
from jaxnbv.studies.parts.discovery import TARGET, PartDiscoveryStudy
from jaxnbv.viz.layout import framed
from jaxnbv.viz.style import GREY

_SHOWN = ("discrete", "gradient-2dof", "farthest", "uncertainty")
_FOUND = "#00734f"
# Okabe and Ito's: a category of ShapeNet-part has at most six parts.
_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#56b4e9", "#cc79a7")
# Points of the true surface that are drawn.
_DENSE = 8000


def write_pictures(
    records: Sequence[Record], study: PartDiscoveryStudy, folder: str | Path, scenes: int = 3, pixels: int = 420
) -> list[Path]:
    """Write `parts_<scene>.png` for the scenes with the most parts, one to a category; return the paths.

    First the true object, coloured by part; a row a method, a column a view: the cloud so far, coloured by the part
    that the segmenter says, over the true shape, and how many parts have N_target = 60 points. Methods are the discrete
    and the 2-DOF gradient search, farthest view and uncertainty, those of them that the records hold, else all that
    they do. A method ends once every part has 100 points.

    - `pixels`: along a side of a picture.

    **Raises:** `ValueError` if there are no records, or no method that all of them hold.
    """
    methods = methods_of(records, study.methods, _SHOWN)
    chosen: dict[str, Record] = {}
    for record in sorted(records, key=lambda record: -len(record["parts"])):
        chosen.setdefault(record["category"], record)
    return write_grids(
        list(chosen.values())[:scenes], folder, "parts", lambda one: _clouds(one, study, methods, pixels)
    )


def _clouds(record: Record, study: PartDiscoveryStudy, methods: Sequence[str], pixels: int) -> Grid:
    scene = study.scene(record["scene"])
    asked, segmenter = np.asarray(study.truth(scene)), study.segmenter_of(scene)
    own, point = _palette(len(asked)), jnp.zeros((1, 3))
    labels = jax.eval_shape(segmenter, PointCloud(point, point, jnp.zeros(1, bool))).shape[1]
    colours = np.tile(mpl.colors.to_rgb(GREY), (labels, 1))
    colours[asked] = own
    truth = cast(TriangleMesh, true_mesh(scene.surface))
    points = truth.sample_points(jax.random.key(0), _DENSE)
    of = np.asarray(study.true_parts(scene, jnp.asarray(points, jnp.float32)))
    # From where the part that shows least shows best.
    eyes = places()
    seen = shows_from(truth, eyes, points[::16])
    shares = np.stack([seen[:, of[::16] == part].mean(axis=1) for part in asked if (of[::16] == part).any()], axis=1)
    still = still_of(truth, eyes[np.argmax((shares / np.maximum(shares.max(axis=0), 1e-9)).min(axis=1))], pixels)
    runs = [record["methods"][method] for method in methods]
    known = [study.seen(scene, run) for run in runs]

    def draw(axes: Axes, row: int, column: int) -> None:
        if column > len(runs[row]["views"]) or (column == 0 and row > 0):
            axes.axis("off")
        elif column == 0:
            draw_on(axes, still, points, colours[of])
        else:
            fed, predicted = segmenter.predict(known[row][column - 1][1].cloud)
            mask = np.asarray(fed.mask)
            draw_on(axes, still, np.asarray(fed.points)[mask], colours[np.asarray(predicted)[mask]])
            found = sum(count >= TARGET for count in runs[row]["counts"][column - 1])
            every = found == len(asked)
            if every:
                framed(axes, _FOUND, 1.6)
            text = f"{'✓ ' if every else ''}{found} of {len(asked)} parts"
            axes.set_xlabel(text, fontsize=9, color=_FOUND if every else GREY, fontweight="bold" if every else "normal")

    columns = ["true parts", *(f"view {view + 1}" for view in range(max(len(run["views"]) for run in runs)))]
    marks = {name: {"marker": "o", "color": colour} for name, colour in zip(record["parts"], own, strict=True)}
    caption = f"Points: the part that the segmenter says. Beneath: parts with {TARGET} points. View 1 is given."
    title = f"Scene {record['scene']}: {scene.name}"
    return Grid(title, caption, methods, columns, draw, marks, named=1)


def _palette(count: int) -> Float[np.ndarray, "count 3"]:
    """A colour for each part."""
    if count <= len(_COLOURS):
        return np.array([mpl.colors.to_rgb(colour) for colour in _COLOURS[:count]])
    return mpl.colormaps["turbo"](np.linspace(0.05, 0.95, count))[:, :3]
