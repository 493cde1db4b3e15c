"""The reconstruction study's pictures: what each method's views give, beside the true surface."""

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import jax
import numpy as np
import trimesh
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from jaxnbv.checks import InputError
from jaxnbv.scanning import TriangleMesh
from jaxnbv.scanning.metrics import true_mesh
from jaxnbv.studies.engine.measures import Record, methods_of
from jaxnbv.studies.engine.tiles import Tiles, first_scenes, save_pictures
from jaxnbv.studies.reconstruction.study import RECONSTRUCTIONS, ReconstructionStudy, reconstruct
from jaxnbv.viz.data import MeanSurface
from jaxnbv.viz.render import Still
from jaxnbv.viz.style import DEVIATION, GREY, log_ticks

# Distances to the truth that the pictures tell apart: from the sensor's noise to a fifth of the object.
_ERRORS = LogNorm(0.01, 0.5)
# Shading and colours are those of the vertices, so no triangle may be larger than what they vary over.
_EDGE = 0.05
# Half of what a picture spans.
_REACH = 1.55


def write_pictures(
    records: Sequence[Record],
    study: ReconstructionStudy,
    folder: str | Path,
    scenes: int = 3,
    pixels: int = 420,
    dense: int = 200_000,
) -> list[Path]:
    """Write `surfaces_<scene>.png` for the first scenes, not picked ones; return the paths.

    A row a reconstruction, a column a method, beside the true surface: seen from the side away from the first view,
    which all methods share, and coloured by the distance to the true surface. Views are scanned again as they were.

    - `pixels`: along a side of a picture; `dense`: points of the true surface that errors are measured to.

    **Raises:** `ValueError` as `methods_of` does, or for a scene that the study does not have.
    """
    methods = methods_of(records, study.methods)
    chosen = first_scenes(records, scenes)
    return save_pictures(chosen, folder, "surfaces", lambda one: _picture(one, study, methods, pixels, dense))


def _picture(record: Record, study: ReconstructionStudy, methods: Sequence[str], pixels: int, dense: int) -> Figure:
    scene = study.scene(record["scene"])
    truth = cast(TriangleMesh, true_mesh(scene.surface))
    tree = cKDTree(truth.sample_points(jax.random.key(0), dense))
    eye = _eye(np.asarray(study.candidates.poses().position[record["first"]], np.float64))
    held = [record["methods"][method]["reconstructions"] for method in methods]
    names = [name for name in RECONSTRUCTIONS if all(found[name] is not None for found in held)]
    imagination = study.mesher(scene).imagination
    known = [study.seen(scene, record["methods"][method])[-1][1] for method in methods]

    images = {"truth": _image(truth, None, eye, pixels)}
    for method, evidence in zip(methods, known, strict=True):
        for name in names:
            mesh = reconstruct(imagination, evidence, name)
            if mesh is None:
                raise InputError(f'the records hold {name}: pip install "jaxnbv[poisson]" to draw it again')
            images[f"{name}, {method}"] = _image(mesh, tree, eye, pixels)
    seen = np.any([image[..., 3] > 0 for image in images.values()], axis=0)
    rows, columns = (np.flatnonzero(seen.any(axis=axis)) for axis in (1, 0))
    crop = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)

    # Inches.
    tile, gap, named, below, left, top, bottom = 1.6, 0.15, 0.35, 0.32, 0.12, 0.62, 0.5
    high = tile * (crop[0].stop - crop[0].start) / (crop[1].stop - crop[1].start)
    start = left + tile + named
    wide, tall = start + len(methods) * (tile + gap), top + len(names) * (high + below) + bottom
    tiles = Tiles(wide, tall, record["name"])

    def show(image: str, x: float, row: int | float, title: str = "") -> Axes:
        axes = tiles.place(x, top + row * (high + below), tile, high)
        axes.imshow(images[image][crop], interpolation="antialiased", aspect="auto")
        axes.set_title(title, fontsize=9, loc="center", pad=4)
        axes.axis("off")
        return axes

    show("truth", left, 0.5 * (len(names) - 1), "true surface")
    for row, name in enumerate(names):
        down = top + row * (high + below) + 0.5 * high
        upright = name.replace(" ", "\n")
        tiles.write(start - 0.5 * named, down, upright, fontsize=8, color=GREY, rotation=90, ha="center")
        for column, (method, found) in enumerate(zip(methods, held, strict=True)):
            axes = show(f"{name}, {method}", start + column * (tile + gap), row, method if row == 0 else "")
            text = f"CD {found[name]['chamfer']:.3f}   HD {found[name]['hausdorff']:.3f}"
            axes.text(0.5, -0.04, text, transform=axes.transAxes, ha="center", va="top", fontsize=8)
    scale = tiles.place(wide - 3.4, tall - 0.44, 3.2, 0.08)
    bar = tiles.figure.colorbar(ScalarMappable(_ERRORS, DEVIATION), cax=scale, orientation="horizontal", extend="both")
    ticks = log_ticks(float(_ERRORS.vmin or 0), float(_ERRORS.vmax or 1)).tolist()
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.ax.minorticks_off()
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=7, length=2)
    label = "distance to the true surface\n(scene units)"
    tiles.write(wide - 3.5, tall - 0.33, label, fontsize=8, ha="right")
    return tiles.figure


def _eye(first: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Where to look from: across the object from the first camera, and from above."""
    across = -first[[0, 2]]
    length = np.linalg.norm(across)
    across = across / length if length > 1e-3 else np.array([0.6, 0.8])
    return np.array([across[0], 0.55, across[1]])


def _image(
    mesh: TriangleMesh, truth: cKDTree | None, eye: Float[np.ndarray, "3"], pixels: int
) -> Float[np.ndarray, "h w 4"]:
    """Trace a mesh, plain or coloured by the distance to points of the true surface."""
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, _EDGE, max_iter=12)
    fine = trimesh.Trimesh(vertices, faces)
    error = np.ones(len(fine.vertices)) if truth is None else truth.query(fine.vertices)[0]
    # A still colours whatever positive number stands at its vertices.
    surface = MeanSurface(
        np.asarray(fine.vertices), np.asarray(fine.faces), np.asarray(fine.vertex_normals), np.maximum(error, 1e-6)
    )
    still = Still(eye, surface, pixels, _REACH)
    still.paint(None if truth is None else _ERRORS)
    return still.image
