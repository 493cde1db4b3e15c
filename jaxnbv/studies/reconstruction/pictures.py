"""What each method's views give, beside the true surface."""

from collections.abc import Sequence
from typing import cast

import jax
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from scipy.spatial import cKDTree

from jaxnbv.checks import InputError
from jaxnbv.errors import install
from jaxnbv.scanning import TriangleMesh
from jaxnbv.scanning.metrics import true_mesh
from jaxnbv.studies.engine.measures import Record
from jaxnbv.studies.engine.pictures import Tiles, across, say, still_of
from jaxnbv.studies.reconstruction.study import RECONSTRUCTIONS, ReconstructionStudy, reconstruct
from jaxnbv.viz.style import DEVIATION

# Distances to the truth that the pictures tell apart: from the sensor's noise to a fifth of the object.
_ERRORS = LogNorm(0.01, 0.5)
# Points of the true surface that errors are measured to.
_DENSE = 200_000


def tiles(study: ReconstructionStudy, record: Record, methods: Sequence[str], pixels: int) -> Tiles:
    """Each reconstruction after the last view, coloured by the distance to the true surface."""
    scene, held = study.scene(record["scene"]), record["methods"]
    truth = cast(TriangleMesh, true_mesh(scene.surface))
    tree = cKDTree(truth.sample_points(jax.random.key(0), _DENSE))
    eye, imagination = across(study, record), study.mesher(scene).imagination
    known = {method: study.seen(scene, held[method])[-1][1] for method in methods}
    made = {method: held[method]["reconstructions"] for method in methods}
    names = tuple(name for name in RECONSTRUCTIONS if all(found[name] is not None for found in made.values()))

    def tile(axes: Axes, method: str, column: int) -> None:
        mesh = reconstruct(imagination, known[method], names[column])
        if mesh is None:
            raise InputError(f"the records hold {names[column]}: to draw it again, {install('poisson')}")
        still = still_of(mesh, eye, pixels, lambda points: tree.query(points)[0], _ERRORS)
        axes.imshow(still.image, interpolation="antialiased")
        found = made[method][names[column]]
        say(axes, f"CD {found['chamfer']:.3f}, HD {found['hausdorff']:.3f}")

    scale = ScalarMappable(_ERRORS, DEVIATION), "distance to the true surface\n(scene units)"
    return Tiles("", tile, lambda axes: axes.imshow(still_of(truth, eye, pixels).image), names, scale=scale)
