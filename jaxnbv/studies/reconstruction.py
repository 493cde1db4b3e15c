"""Study of reconstruction: how near the surface made from a method's views is to the true surface."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, cast

import jax
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from scipy.spatial import cKDTree

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import InputError
from jaxnbv.errors import install
from jaxnbv.networks.categories import CATEGORIES
from jaxnbv.observations import Observations
from jaxnbv.planning.loop import Step
from jaxnbv.planning.planner import Planner
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import SDFSurface, TriangleMesh
from jaxnbv.scanning.metrics import SURFACE_POINTS, coverage, surface_distance, true_mesh, truth_points
from jaxnbv.scanning.screened_poisson import has_poisson, screened_poisson
from jaxnbv.studies.engine.measures import Claim, Measure, Record
from jaxnbv.studies.engine.run import replay
from jaxnbv.studies.engine.searches import BASELINES
from jaxnbv.studies.engine.study import Scene, Study
from jaxnbv.studies.engine.tiles import ERRORS, ScenePicture, caption_tile, opposite_direction, render_mesh
from jaxnbv.studies.scenes import Split, part_scene
from jaxnbv.tasks import Coverage, NewSurface
from jaxnbv.viz.style import DEVIATION

POISSON, MEAN = "screened Poisson", "posterior mean"
RECONSTRUCTIONS = (POISSON, MEAN)
# Number of points on the true surface to which pictures measure distances.
_NUM_DENSE_POINTS = 200_000


def _distance_measure(name: str, title: str) -> Measure:
    def compute(record: Record, method: str) -> dict[str, float | None]:
        by_reconstruction = record["methods"][method]["reconstructions"].items()
        return {key: None if distances is None else distances[name] for key, distances in by_reconstruction}

    return Measure(name, title, compute, "reconstruction", "scene units", lower_is_better=True)


class ReconstructionStudy(Study):
    """Measures the distance between the surface reconstructed from a method's cloud and the true surface.

    There are two reconstructions: screened Poisson, and the posterior mean, which is meshed on the grid of the samples
    and carved like the samples. Procedural objects come from the test split of `part_scene`.
    """

    title: ClassVar[str] = "Distances to the true surface after the last view"
    explanation: ClassVar[str] = (
        "In scene units (longest side 2.5). Accuracy is the mean distance from the reconstruction to the truth,\n"
        "completeness the mean distance from the truth to the reconstruction, and the Chamfer distance CD their sum.\n"
        "HD, the Hausdorff distance, is the largest distance in both directions. A reconstruction is left out if no\n"
        "scene has it: screened Poisson needs pip install pymeshlab."
    )
    bank: ClassVar[str] = "parts"
    without_bank: ClassVar[tuple[str, ...]] = ("coverage", "new-surface", "uncertainty")
    methods: ClassVar[tuple[str, ...]] = ("coverage", "new-surface", *BASELINES)
    reference: ClassVar[str] = "coverage"
    measures: ClassVar[tuple[Measure, ...]] = (
        _distance_measure("chamfer", "Chamfer distance"),
        _distance_measure("hausdorff", "Hausdorff distance"),
        _distance_measure("accuracy", "Accuracy"),
        _distance_measure("completeness", "Completeness"),
        Measure("covered", "Surface covered", lambda r, m: r["methods"][m]["coverage"], unit="%"),
    )
    claims: ClassVar[tuple[Claim, ...]] = (
        Claim(
            "Surfaces from coverage's views are as near to the truth as surfaces from baselines designed for coverage.",
            "chamfer",
            POISSON,
            ("farthest", "uncertainty"),
            must_be_better=False,
        ),
    )
    seed: ClassVar[int] = 4
    quick: ClassVar[Mapping[str, Any]] = {**Study.quick, "num_candidates": 40}

    def scene(self, index: int) -> Scene:
        file = self.mesh_file(index)
        if file is not None:
            return Scene(index, file.name, file.read())
        part = part_scene(Split.TEST, index)
        return Scene(index, f"{CATEGORIES[int(part.category)].name} {index}", SDFSurface(part.solid))

    def acquisition(self, method: str, scene: Scene) -> Acquisition:
        return NewSurface() if method == "new-surface" else Coverage()

    def mesher(self, scene: Scene) -> Planner:
        """Return the planner whose sampler reconstructs the surface for all methods, including the user's own."""
        return self.planner("farthest", scene)

    def truth(self, scene: Scene) -> Float[np.ndarray, "n 3"]:
        """Return points on the true surface, uniformly distributed by area.

        **Raises:** `ValueError` if the surface cannot be sampled.
        """
        points = truth_points(scene.surface, self.key(scene.index, "scene"), SURFACE_POINTS)
        if points is None:
            raise InputError(f"the surface of scene {scene.index} cannot be sampled: give a mesh")
        return points

    def follow(
        self, scene: Scene, truth: Float[np.ndarray, "n 3"], planner: Planner, episode: Iterator[Step]
    ) -> Record:
        """Record the fraction of the surface covered after each view, and the final reconstruction errors.

        The errors of screened Poisson are None if `pymeshlab` is not installed.
        """
        views = [view for view, *_ in episode]
        mesher = self.mesher(scene)
        *_, observations = mesher.replay(((view.pose, view.scan) for view in views), self.camera)
        distances = {
            name: self._distances(reconstruct(mesher.sampler, observations, name), truth, scene.index)
            for name in RECONSTRUCTIONS
        }
        count = int(observations.cloud.count)
        return {"coverage": coverage(views, truth), "points": count, "reconstructions": distances}

    def _distances(self, mesh: TriangleMesh | None, truth: Float[np.ndarray, "n 3"], index: int) -> Record | None:
        if mesh is None:
            return None
        distance = surface_distance(mesh.sample_points(self.key(index, "measure"), SURFACE_POINTS), truth)
        return {"chamfer": distance.chamfer, **distance._asdict()}

    def scene_picture(self, record: Record, methods: Sequence[str], pixels: int) -> ScenePicture:
        """Return a picture of each reconstruction after the last view, coloured by distance to the truth.

        **Raises:** `ValueError` if the record has results of screened Poisson, but `pymeshlab` is not installed.
        """
        scene, runs = self.scene(record["scene"]), record["methods"]
        truth = cast(TriangleMesh, true_mesh(scene.surface))
        tree = cKDTree(truth.sample_points(jax.random.key(0), _NUM_DENSE_POINTS))
        eye, sampler = opposite_direction(record), self.mesher(scene).sampler
        last_observations = {method: replay(self, scene, runs[method])[-1][1] for method in methods}
        results = {method: runs[method]["reconstructions"] for method in methods}
        names = tuple(name for name in RECONSTRUCTIONS if all(run[name] is not None for run in results.values()))

        def tile(axes: Axes, method: str, column: int) -> None:
            mesh = reconstruct(sampler, last_observations[method], names[column])
            if mesh is None:
                raise InputError(f"the records hold {names[column]}: to draw it again, {install('poisson')}")
            rendering = render_mesh(mesh, eye, pixels, lambda points: tree.query(points)[0])
            axes.imshow(rendering.image, interpolation="antialiased")
            distances = results[method][names[column]]
            caption_tile(axes, f"CD {distances['chamfer']:.3f}, HD {distances['hausdorff']:.3f}")

        scale = ScalarMappable(ERRORS, DEVIATION), "distance to the true surface\n(scene units)"
        return ScenePicture(
            "", tile, lambda axes: axes.imshow(render_mesh(truth, eye, pixels).image), names, scale=scale
        )


def reconstruct(sampler: SurfaceSampler, observations: Observations, name: str) -> TriangleMesh | None:
    """Return a reconstruction of `RECONSTRUCTIONS`; None for `POISSON` if `pymeshlab` is not installed."""
    if name == MEAN:
        return sampler.mean_mesh(observations)
    return screened_poisson(observations.cloud) if has_poisson() else None
