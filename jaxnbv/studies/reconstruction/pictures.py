"""The reconstruction study's pictures: what each method's views give, beside the true surface."""

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import jax
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from scipy.spatial import cKDTree

from jaxnbv.checks import InputError
from jaxnbv.errors import install
from jaxnbv.scanning import TriangleMesh
from jaxnbv.scanning.metrics import true_mesh
from jaxnbv.studies.engine.measures import Record, methods_of
from jaxnbv.studies.engine.pictures import Grid, first_scenes, still_of, write_grids
from jaxnbv.studies.reconstruction.study import RECONSTRUCTIONS, ReconstructionStudy, reconstruct
from jaxnbv.viz.style import DEVIATION

# Distances to the truth that the pictures tell apart: from the sensor's noise to a fifth of the object.
_ERRORS = LogNorm(0.01, 0.5)


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
    methods, chosen = methods_of(records, study.methods), first_scenes(records, scenes)
    return write_grids(chosen, folder, "surfaces", lambda one: _surfaces(one, study, methods, pixels, dense))


def _surfaces(record: Record, study: ReconstructionStudy, methods: Sequence[str], pixels: int, dense: int) -> Grid:
    scene = study.scene(record["scene"])
    truth = cast(TriangleMesh, true_mesh(scene.surface))
    tree = cKDTree(truth.sample_points(jax.random.key(0), dense))
    eye = _eye(np.asarray(study.candidates.poses().position[record["first"]], np.float64))
    held = [record["methods"][method]["reconstructions"] for method in methods]
    names = [name for name in RECONSTRUCTIONS if all(found[name] is not None for found in held)]
    imagination = study.mesher(scene).imagination
    known = [study.seen(scene, record["methods"][method])[-1][1] for method in methods]

    def draw(axes: Axes, row: int, column: int) -> None:
        axes.axis("off")
        if column == 0:
            if row == 0:
                axes.imshow(still_of(truth, eye, pixels).image, interpolation="antialiased")
            return
        mesh = reconstruct(imagination, known[column - 1], names[row])
        if mesh is None:
            raise InputError(f"the records hold {names[row]}: to draw it again, {install('poisson')}")
        still = still_of(mesh, eye, pixels, lambda points: tree.query(points)[0], _ERRORS)
        axes.imshow(still.image, interpolation="antialiased")
        found = held[column - 1][names[row]]
        text = f"{names[row]}\nCD {found['chamfer']:.3f}, HD {found['hausdorff']:.3f}"
        axes.text(0.5, 0.0, text, transform=axes.transAxes, ha="center", va="top", fontsize=8)

    scale = ScalarMappable(_ERRORS, DEVIATION), "distance to the true surface\n(scene units)"
    return Grid(record["name"], "", names, ["true surface", *methods], draw, scale=scale)


def _eye(first: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Where to look from: across the object from the first camera, and from above."""
    across = -first[[0, 2]]
    length = np.linalg.norm(across)
    across = across / length if length > 1e-3 else np.array([0.6, 0.8])
    return np.array([across[0], 0.55, across[1]])
