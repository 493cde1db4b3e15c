"""The posterior over surfaces, p(f | D), and its samples on a grid."""

import dataclasses
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.checks import (
    InputError,
    check_fields,
    check_key,
    check_type,
    checked,
    is_traced,
    own_settings,
    require,
    short_text,
    takes_native,
)
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.volume import Box, Volume, bounding_box
from jaxnbv.observations import Observations, as_observations
from jaxnbv.programs import program
from jaxnbv.scanning import Carving, Grid, GridSurface, TriangleMesh, carve
from jaxnbv.scanning.grid import touched_cells
from jaxnbv.scanning.mesh import level_triangles, supported_pieces
from jaxnbv.surfaces import (
    EmptySpace,
    GeometricSPSR,
    KnownShapes,
    OnSurface,
    OutsideBoundary,
    ScreenedSPSR,
    ShapeBank,
    ShapePoses,
    SurfaceModel,
    SurfacePosterior,
)
from jaxnbv.surfaces.known_shapes import short_ranged

# How far the object may continue beyond a box that cuts it, in scene units. It is 8 % of the longest side, 2.5.
_MARGIN = 0.2

MODELS = ("screened", "paper")
"""The names that `SurfaceSampler.preset` accepts."""


class StepInputs(eqx.Module):
    """The inputs of one step. A step is the computation that chooses the next view.

    - `posterior`: p(f | observations); None if nothing needs it.
    - `surfaces`: samples of the posterior along a leading axis; None if nothing needs them.
    """

    observations: Observations
    posterior: SurfacePosterior | None = None
    surfaces: GridSurface | None = None


class SurfaceSampler(eqx.Module):
    """A distribution over surfaces, and the settings for sampling it.

    - `model`: the prior over surfaces.
    - `grid`: the grid on which samples are evaluated and scanned, and on which empty space is stored.
    - `num_samples`: number of posterior samples per step.
    - `carving`: removes sampled surface from space that was seen to be empty, and from outside a volume. Some models,
      such as `ScreenedSPSR`, are also conditioned on the empty space. With None, nothing is removed, empty space is not
      used, and samples depend only on the cloud D, as in the paper.

    No sample extends into a known obstacle, with or without carving. Methods accept `Observations` on the same grid, or
    a `PointCloud`.

    **Raises:** `ValueError` if `num_samples` is below 1, or if the grid extends beyond the torus [-pi, pi]^3.
    """

    model: SurfaceModel = eqx.field(default_factory=ScreenedSPSR)
    grid: Grid = Grid()
    num_samples: int = eqx.field(static=True, default=16)
    carving: Carving | None = Carving()

    def __check_init__(self):
        check_fields(self)
        require(self.num_samples >= 1, f"num_samples is {self.num_samples}; it must be at least 1")
        require(
            self.grid.half_extent <= np.pi,
            f"the grid extends to {self.grid.half_extent}, beyond the torus [-pi, pi]^3: give Grid(half_extent=...)",
        )

    @classmethod
    @checked
    def preset(
        cls,
        name: str = "screened",
        longest_side: float = 2.5,
        quick: bool = False,
        volume: Volume | None = None,
        solid: bool = False,
    ) -> "SurfaceSampler":
        """Return the sampler with this name for an object of this size.

        - `name`: "screened" is the default `ScreenedSPSR`, with lengths in proportion to the longest side. The boundary
          of the volume counts as outside. Samples are carved, so they avoid empty space and stay in the volume.
          "paper" is the published model with its published values. It uses normals only, without carving.
        - `longest_side`: longest side of the object's bounding box, in scene units.
        - `quick`: use fewer frequencies.
        - `volume`: region that can hold the object, by default a cube about the origin with sides of `longest_side`. A
          volume that you pass may cut the object.
        - `solid`: leave out `EmptySpace`, which assumes that unseen space next to empty space is probably empty too.
          This assumption is wrong for a body whose hidden side is as large as its visible side, such as the pyramid.

        **Raises:** `ValueError` for an unknown name, or a longest side that is not positive.
        """
        require(longest_side > 0, f"the longest side is {longest_side}; it must be positive")
        require(name in MODELS, f"there is no model {name!r}: choose from {', '.join(MODELS)}")
        if name == "paper":
            return cls(GeometricSPSR(0.015, truncation=20) if quick else GeometricSPSR(), carving=None)
        scale, default = longest_side / 2.5, ScreenedSPSR()
        margin, volume = (0.0, Box.cube(longest_side)) if volume is None else (scale * _MARGIN, volume)
        lengthscales = scale * (default.base.lengthscale + (jnp.array([0.005, 0.0]) if quick else 0.0))
        # Shorter lengthscales need more frequencies, but time and memory grow with the cube of the truncation.
        truncation = min(round((20 if quick else default.base.truncation) / scale), 30 if quick else 48)
        base = GeometricSPSR(lengthscales, default.base.variance, truncation)
        values = (OutsideBoundary(volume, margin=margin), OnSurface(), *(() if solid else (EmptySpace(),)))
        return cls(ScreenedSPSR(base, values, offset=scale * default.offset), carving=Carving(volume))

    @own_settings()
    def with_bank(self, bank: ShapeBank, poses: ShapePoses) -> "SurfaceSampler":
        """Return a copy whose prior is `KnownShapes`, with the current model for "none of these".

        - `bank`, `poses`: the known shapes, and their possible placements. Shapes are registered within the carving's
          volume, or within `Box()` if there is no carving.
        """
        box = Box() if self.carving is None else bounding_box(self.carving.volume)
        longest_side = float(np.max(box.high - box.low))
        truncations = (self.model.base.truncation,) if isinstance(self.model, ScreenedSPSR) else ()
        return dataclasses.replace(
            self, model=KnownShapes(bank, short_ranged(longest_side, *truncations), poses, box, self.model)
        )

    @property
    def without_bank(self) -> "SurfaceSampler":
        """A copy without a bank, whose prior is the model for "none of these"."""
        return (
            dataclasses.replace(self, model=self.model.model_of_none) if isinstance(self.model, KnownShapes) else self
        )

    @own_settings()
    def within(self, volume: Box) -> "SurfaceSampler":
        """Return a copy in which `volume` replaces every default `Box()`. The volume may cut the object."""

        def replace(leaf):
            if isinstance(leaf, OutsideBoundary):
                return (
                    dataclasses.replace(leaf, volume=volume, margin=_MARGIN) if replace(leaf.volume) is volume else leaf
                )
            return volume if isinstance(leaf, Box) and leaf == Box() else leaf

        return jax.tree.map(replace, self, is_leaf=lambda leaf: isinstance(leaf, Box | OutsideBoundary))

    @own_settings()
    def posterior(self, observations: Observations | PointCloud) -> SurfacePosterior:
        """Return p(f | observations), without carving. Empty nodes outside the volume are ignored.

        **Raises:** `ValueError` if the observations have a different grid than the sampler, and whenever the model's
        `condition` raises it.
        """
        observations = self.adapt(observations)
        if self.carving is None or observations.empty_nodes is None:
            return self.model.condition(observations)
        empty_nodes = observations.empty_nodes & self.carving.inside(self.grid)
        return self.model.condition(dataclasses.replace(observations, empty_nodes=empty_nodes))

    @own_settings()
    def sample(
        self, observations: Observations | PointCloud, key: PRNGKeyArray, posterior: SurfacePosterior | None = None
    ) -> GridSurface:
        """Draw `num_samples` carved samples of the surface on the grid, along a leading axis.

        - `posterior`: the result of `posterior(observations)`, if it is already computed.

        **Raises:** `ValueError` if the samples are not finite, and whenever `SurfaceSampler.posterior` raises it.
        """
        check_key(key)
        check_type(posterior, SurfacePosterior | None, "the posterior")
        observations = self.adapt(observations)
        # The posterior is a separate program, so callers that also use the posterior do not compile it twice.
        posterior = self.posterior(observations) if posterior is None else posterior
        surfaces = _sample(self, observations, key, posterior)
        if not is_traced(surfaces):
            require(
                bool(jnp.isfinite(surfaces.values).all()),
                f"the samples of the surface given {int(observations.cloud.count)} points are not finite: raise the "
                "model's noise, or enable jax_enable_x64",
            )
        return surfaces

    @own_settings()
    def step_inputs(self, observations: Observations | PointCloud, key: PRNGKeyArray) -> StepInputs:
        """Return the observations, their posterior and `num_samples` samples of the posterior.

        **Raises:** `ValueError` whenever `sample` raises it.
        """
        observations = self.adapt(observations)
        posterior = self.posterior(observations)
        return StepInputs(observations, posterior, self.sample(observations, key, posterior))

    @own_settings()
    @takes_native
    def carve(
        self, observations: Observations | PointCloud, values: Float[Array, "*s g g g"]
    ) -> Float[Array, "*s g g g"]:
        """Make values positive at nodes where no object can be: empty, in an obstacle, or outside the volume.

        - `values`: f minus the level, at the grid's nodes.

        **Raises:** `ValueError` if the values or the observations have a different grid than the sampler.
        """
        observations, nodes = self.adapt(observations), (self.grid.resolution,) * 3
        require(jnp.shape(values)[-3:] == nodes, f"the values are {short_text(values)}, but the grid has {nodes} nodes")
        is_excluded = observations.obstacle_nodes
        if self.carving is not None and observations.empty_nodes is not None:
            is_outside = observations.empty_nodes | self.carving.outside(self.grid)
            is_excluded = is_outside if is_excluded is None else is_outside | is_excluded
        return values if is_excluded is None else carve(values, is_excluded)

    @own_settings()
    def mean(
        self, observations: Observations | PointCloud, posterior: SurfacePosterior | None = None
    ) -> Float[Array, "g g g"]:
        """Return the posterior mean of f minus the level, at the grid's nodes and carved like the samples.

        **Raises:** `ValueError` whenever `SurfaceSampler.posterior` raises it.
        """
        posterior = self.posterior(observations) if posterior is None else posterior
        values = posterior.mean_on_grid(self.grid.axis.astype(posterior.level.dtype)) - posterior.level
        return self.carve(observations, values)

    @own_settings()
    def probability_inside(self, observations: Observations | PointCloud) -> Float[Array, "g g g"]:
        """Return P(f < level | observations) at the grid's nodes.

        The estimate is the fraction of `num_samples` carved samples, drawn with a fixed key, that are below the level.

        **Raises:** `ValueError` whenever `sample` raises it.
        """
        return jnp.mean(self.sample(observations, jax.random.key(0)).values < 0, axis=0)

    @own_settings()
    def mean_mesh(self, observations: Observations | PointCloud) -> TriangleMesh:
        """Return a mesh of the surface where the carved posterior mean equals its level (marching cubes).

        The mesh is in scene coordinates (its frame is the identity), with faces wound outward. Where nothing was
        scanned, the mesh shows the surface that the model predicts. Connected components with fewer than four points of
        the cloud near them are left out with a warning. If the surface leaves the grid, the mesh has an open edge
        there.

        **Raises:** `ValueError` if the mean equals its level nowhere in the grid, and whenever
        `SurfaceSampler.posterior` raises it.
        """
        values = np.array(self.mean(observations))
        triangles = level_triangles(values, self.grid)
        if triangles is None:
            half = self.grid.half_extent
            raise InputError(
                f"the posterior mean minus its level is from {values.min():.4g} to {values.max():.4g} on the grid, so "
                f"no surface lies within [-{half}, {half}]^3: give a finer Grid, or one whose half extent holds the "
                "cloud"
            )
        points, _ = self.adapt(observations).cloud.to_numpy()
        vertices, faces, count = supported_pieces(*triangles[:2], points, self.grid.spacing)
        if count:
            warnings.warn(
                f"left out {count} piece{'s' * (count > 1)} of the mesh with hardly any points of the cloud",
                stacklevel=2,
            )
        return TriangleMesh(vertices, faces, Frame())

    def adapt(self, observations: Observations | PointCloud) -> Observations:
        """Return the observations as this sampler uses them.

        A `PointCloud` becomes observations without views. Without carving, the empty nodes are dropped. If there are no
        obstacles either, the grid and `looks` are dropped too.

        **Raises:** `ValueError` if the observations have a different grid than the sampler, or if they have no grid
        although samples are carved.
        """
        grid = None if self.carving is None else self.grid
        if isinstance(observations, PointCloud):
            return Observations.start(as_observations(observations).cloud, grid=grid)
        observations = as_observations(observations)
        if observations.obstacle_nodes is not None:
            grid = self.grid
        elif grid is None:
            observations = dataclasses.replace(observations, grid=None, looks=None)
        require(
            bool(observations.grid == grid),
            f"the observations keep empty space on {observations.grid}, but surfaces are carved on {self.grid}: start "
            "them with `init` of the planner that uses them",
        )
        return observations if self.carving is not None else dataclasses.replace(observations, empty_nodes=None)


@program
def _sample(
    sampler: SurfaceSampler, observations: Observations, key: PRNGKeyArray, posterior: SurfacePosterior
) -> GridSurface:
    fields = posterior.sample(key, sampler.num_samples)
    values = fields.on_grid(sampler.grid.axis) - posterior.level
    surfaces = GridSurface.from_values(sampler.carve(observations, values), 0.0, sampler.grid)
    if sampler.carving is None:
        return surfaces
    # If an object continues beyond the volume, the volume cuts it. The cut is not part of the object's surface.
    return surfaces.without_cells(touched_cells((values <= 0) & sampler.carving.outside(sampler.grid)))
