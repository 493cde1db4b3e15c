"""What is imagined: the surfaces that are held possible given what has been seen.

A `SurfaceSampler` is all that a sampled surface depends on but the observations: the model, the grid on which samples
are evaluated, how many are drawn, what cuts them, and what stands around the object.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxnbv.checks import InputError, check_fields, check_key, check_type, checked, is_traced, require, shown
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud, check_oriented, check_single, concatenate, limit_capacity
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box, Volume, bounding_box
from jaxnbv.observations import Observations
from jaxnbv.scanning import (
    Carving,
    Grid,
    GridSurface,
    Obstacles,
    TriangleMesh,
    carve,
    scan_samples,
)
from jaxnbv.scanning.mesh import level_triangles
from jaxnbv.surfaces import (
    GeometricSPSR,
    KnownShapes,
    OnSurface,
    OutsideBoundary,
    ScreenedSPSR,
    SeenEmpty,
    ShapeBank,
    ShapePoses,
    SurfaceModel,
    SurfacePosterior,
)
from jaxnbv.surfaces.base import HALF_WIDTH
from jaxnbv.surfaces.known_shapes import short_ranged

MODELS = ("screened", "paper")
"""The names of `SurfaceSampler.preset`."""


class StepInputs(eqx.Module):
    """What one step looks at, computed once.

    - `observations`: what has been seen.
    - `posterior`: p(f | observations); None where nothing asks for it.
    - `surfaces`: S samples of it along a leading axis; None where nothing asks for them.
    """

    observations: Observations
    posterior: SurfacePosterior | None = None
    surfaces: GridSurface | None = None


class SurfaceSampler(eqx.Module):
    """A distribution over surfaces, as a planner imagines them.

    - `model`: the prior over surfaces.
    - `grid`: where samples are evaluated and scanned; empty space is known at its nodes.
    - `num_samples`: S, posterior samples a step.
    - `carving`: what samples are cut by: space seen empty, on which the model is conditioned too where it can be, and
      the outside of a volume. None leaves samples as the model draws them from D, which is the paper's own behaviour.
    - `obstacles`: what stands around the object, hides it, and keeps cameras out; None for nothing.

    Observations is an `Observations` of the same grid, or a cloud alone.

    **Raises:** `ValueError` for no samples, or a grid beyond the torus [-pi, pi]^3.
    """

    model: SurfaceModel = eqx.field(default_factory=ScreenedSPSR)
    grid: Grid = Grid()
    num_samples: int = eqx.field(static=True, default=16)
    carving: Carving | None = Carving()
    obstacles: Obstacles | None = None

    def __check_init__(self):
        check_fields(self)
        require(self.num_samples >= 1, f"num_samples is {self.num_samples}; it must be at least 1")
        require(
            self.grid.half_extent <= np.pi,
            f"the grid reaches to {self.grid.half_extent}, beyond the torus [-pi, pi]^3: give Grid(half_extent=...)",
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
        """The surfaces of a name, for an object whose box has this longest side, in scene units.

        - `screened`: the default `ScreenedSPSR`, whose lengths are taken in proportion to the longest side and for
          which the boundary of the volume is outside; carved, so that nothing is inside where the sensor saw empty
          space, nor outside the volume.
        - `paper`: the published model at its published values, which conditions on normals alone; not carved.
        - `quick`: with fewer frequencies.
        - `volume`: by default the cube of the longest side about the origin.
        - `solid`: for a body that is nowhere thin, such as the pyramid: its hidden side is as large as the one that was
          seen, so that nothing follows for the space beside what was seen empty (`SeenEmpty`).

        **Raises:** `ValueError` for another name, or a longest side that is not positive.
        """
        require(longest_side > 0, f"the longest side is {longest_side}; it must be positive")
        require(name in MODELS, f"there is no model {name!r}: choose from {', '.join(MODELS)}")
        if name == "paper":
            return cls(GeometricSPSR(0.015, truncation=20) if quick else GeometricSPSR(), carving=None)
        volume = Box.cube(longest_side) if volume is None else volume
        scale, usual = longest_side / 2.5, ScreenedSPSR()
        lengthscales = scale * (usual.base.lengthscale + (jnp.array([0.005, 0.0]) if quick else 0.0))
        # Shorter scales need more frequencies, but time and memory grow with their cube.
        truncation = min(round((20 if quick else usual.base.truncation) / scale), 30 if quick else 48)
        base = GeometricSPSR(lengthscales, usual.base.variance, truncation)
        values = (OutsideBoundary(volume), OnSurface(), *(() if solid else (SeenEmpty(),)))
        return cls(ScreenedSPSR(base, values, offset=scale * usual.offset), carving=Carving(volume))

    def with_bank(self, bank: ShapeBank, poses: ShapePoses) -> "SurfaceSampler":
        """The same of one who has seen these shapes before: `KnownShapes`, registered within the volume, with this
        model as the answer to "none of these".

        - `poses`: how the shapes can stand in the scene.
        """
        box = Box() if self.carving is None else bounding_box(self.carving.volume)
        longest_side = max(high - low for low, high in zip(box.low, box.high, strict=True))
        own = (self.model.base.truncation,) if isinstance(self.model, ScreenedSPSR) else ()
        return dataclasses.replace(
            self, model=KnownShapes(bank, short_ranged(longest_side, *own), poses, box, self.model)
        )

    @property
    def without_bank(self) -> "SurfaceSampler":
        """The same without its known shapes, if it has any."""
        return dataclasses.replace(self, model=self.model.unknown) if isinstance(self.model, KnownShapes) else self

    def within(self, volume: Box) -> "SurfaceSampler":
        """The same for an object in another box: what holds for the default one, `Box()`, holds for this."""

        def placed(leaf):
            return volume if isinstance(leaf, Box) and leaf == Box() else leaf

        return jax.tree.map(placed, self, is_leaf=lambda leaf: isinstance(leaf, Box))

    def begin(self, cloud: PointCloud, capacity: int, max_views: int) -> Observations:
        """A cloud as observations, before any pose is known.

        - `capacity`: points of it that are kept, by farthest point sampling beyond it.
        - `max_views`: for how many views there is room.
        """
        kept = limit_capacity(cloud, capacity)
        return Observations.before_views(kept, max_views, None if self.carving is None else self.grid)

    def observe(self, observations: Observations, pose: Pose, scan: PointCloud, camera: Camera) -> Observations:
        """The observations after a scan from a pose: its points, where it was taken, and what it shows to be empty.

        **Raises:** `ValueError` for observations of another grid.
        """
        known = self.known(observations)
        known = dataclasses.replace(known, cloud=_joined(known.cloud, scan))
        return _record(self.carving, self.obstacles, known, pose, scan, camera)

    def record(self, observations: Observations, pose: Pose, scan: PointCloud, camera: Camera) -> Observations:
        """The observations after a view whose points it holds already.

        **Raises:** `ValueError` for observations of another grid.
        """
        return _record(self.carving, self.obstacles, self.known(observations), pose, scan, camera)

    def posterior(self, observations: Observations | PointCloud) -> SurfacePosterior:
        """p(f | observations), of which `sample` draws before it carves. Space is known to be empty within the volume.

        **Raises:** `ValueError` as the model's `condition` does, and for observations of another grid.
        """
        observations = self.known(observations)
        if self.carving is None or observations.seen_empty is None:
            return self.model.condition(observations)
        inside = observations.seen_empty & self.carving.inside(self.grid)
        return self.model.condition(dataclasses.replace(observations, seen_empty=inside))

    def sample(
        self, observations: Observations | PointCloud, key: PRNGKeyArray, posterior: SurfacePosterior | None = None
    ) -> GridSurface:
        """S samples of the surface given the observations, carved, on the grid, along a leading axis.

        - `posterior`: that of the observations, where it is at hand already.

        **Raises:** `ValueError` as `posterior` does, and if the model gives values that are not finite.
        """
        check_key(key)
        check_type(posterior, SurfacePosterior | None, "the posterior")
        observations = self.known(observations)
        # On its own, so that whoever asks for the posterior too compiles it once.
        posterior = self.posterior(observations) if posterior is None else posterior
        surfaces = _sample(self, observations, key, posterior)
        if not is_traced(surfaces):
            require(
                bool(jnp.isfinite(surfaces.values).all()),
                f"the samples of the surface given {int(observations.cloud.count)} points are not finite: raise the "
                "model's noise, or enable jax_enable_x64",
            )
        return surfaces

    def carve(
        self, observations: Observations | PointCloud, values: Float[Array, "*s g g g"]
    ) -> Float[Array, "*s g g g"]:
        """Values of f minus its level at the grid's nodes, made positive where the object cannot be: in space that was
        seen empty, outside its volume, and within obstacles.

        **Raises:** `ValueError` if the values or the observations are of another grid.
        """
        observations, nodes = self.known(observations), (self.grid.resolution,) * 3
        require(jnp.shape(values)[-3:] == nodes, f"the values are {shown(values)}, but the grid has {nodes} nodes")
        if self.carving is None or observations.seen_empty is None:
            return values
        elsewhere = observations.seen_empty | self.carving.outside(self.grid)
        around = self.obstacles
        return carve(values, elsewhere if around is None else elsewhere | around.within(self.grid))

    def mean(
        self, observations: Observations | PointCloud, posterior: SurfacePosterior | None = None
    ) -> Float[Array, "g g g"]:
        """E f minus the level at the grid's nodes, carved as the samples are.

        **Raises:** `ValueError` as `posterior` does.
        """
        posterior = self.posterior(observations) if posterior is None else posterior
        values = posterior.mean_on_grid(self.grid.axis.astype(posterior.level.dtype)) - posterior.level
        return self.carve(observations, values)

    def probability_inside(self, observations: Observations | PointCloud) -> Float[Array, "g g g"]:
        """P(f < level | observations) at the grid's nodes: the share of S samples under a fixed key, carved, so that
        any model will do.

        **Raises:** `ValueError` as `sample` does.
        """
        return jnp.mean(self.sample(observations, jax.random.key(0)).values < 0, axis=0)

    def mean_mesh(self, observations: Observations | PointCloud) -> TriangleMesh:
        """The surface where the posterior mean equals its level, by marching cubes on the grid, carved as the samples.

        The mesh is in scene coordinates (its frame is the identity), its faces wound outward. Where nothing was scanned
        it is the model's guess. All of it is kept, pieces that hold no point of the cloud included: some continue the
        object behind what was seen, others are not there, and the observations do not tell which. It is open where it
        leaves the grid.

        **Raises:** `ValueError` if the mean does not cross its level within the grid, and as `posterior` does.
        """
        values = np.array(self.mean(observations))
        found = level_triangles(values, self.grid)
        if found is None:
            half = self.grid.half_extent
            raise InputError(
                f"the posterior mean less its level runs from {values.min():.4g} to {values.max():.4g} on the grid, so "
                f"no surface lies within [-{half}, {half}]^3: give a finer Grid, or one whose half extent holds the "
                "cloud"
            )
        return TriangleMesh(found[0], found[1], Frame())

    def barrier(self, camera: Camera, poses: Pose) -> Float[Array, "*batch rays"] | None:
        """How far along a camera's rays from a pose or a batch of them obstacles stand; None without any."""
        return None if self.obstacles is None else self.obstacles.barrier(camera, poses)

    @eqx.filter_jit
    def scan(self, surfaces: GridSurface, camera: Camera, poses: Pose) -> PointCloud:
        """What the camera sees of each of s samples from each of p poses, past what stands around: clouds with leading
        axes (s, p)."""
        return scan_samples(surfaces, camera, poses, self.barrier(camera, poses))

    def known(self, observations: Observations | PointCloud) -> Observations:
        """The observations with what is known of its empty space: none of a cloud alone.

        **Raises:** `ValueError` for observations of another grid, or without empty space where samples are carved.
        """
        if isinstance(observations, PointCloud):
            check_single(observations)
            return Observations.before_views(observations, 0, None if self.carving is None else self.grid)
        check_type(observations, Observations, "the observations")
        if self.carving is None:
            return dataclasses.replace(observations, seen_empty=None, grid=None)
        require(
            bool(observations.grid == self.grid),
            f"the observations keep empty space on {observations.grid}, but surfaces are carved on {self.grid}: make "
            "them with the init of the planner that they are given to",
        )
        return observations

    def check(self, pose: Pose | None, scan: PointCloud, camera: Camera, first: bool) -> None:
        """**Raises:** `ValueError` for a scan that `Planner.init` refuses, or `Planner.observe` if it is not the
        first."""
        for value, hint, name in ((scan, PointCloud, "scan"), (pose, Pose | None, "pose"), (camera, Camera, "camera")):
            check_type(value, hint, f"the {name}")
        check_single(scan, "the scan")
        require(pose is None or pose.position.ndim == 1, "the pose is a batch of poses: give one, poses[0] say")
        if is_traced(scan, pose):
            return
        # Within jit too, values of what is not traced are known.
        with jax.ensure_compile_time_eval():
            if first or bool(scan.mask.any()):
                check_oriented(scan, "the first scan" if first else "the scan", min(self.grid.half_extent, HALF_WIDTH))
            require(
                pose is None or scan.missed is None or scan.capacity == camera.num_rays,
                f"the scan has {scan.capacity} rays but the camera {camera.height} x {camera.width}: give the camera "
                "that took it, as observe(state, pose, scan, camera), and the pose that it was taken from",
            )
            if self.carving is not None:
                self.carving.check_inside(scan, self.grid)


# What is compiled takes what it uses: another model does not compile these again.


@eqx.filter_jit
def _joined(cloud: PointCloud, scan: PointCloud) -> PointCloud:
    return limit_capacity(concatenate(cloud, scan), cloud.capacity)


@eqx.filter_jit
def _record(
    carving: Carving | None,
    obstacles: Obstacles | None,
    observations: Observations,
    pose: Pose,
    scan: PointCloud,
    camera: Camera,
) -> Observations:
    poses = jax.tree.map(lambda rows, row: rows.at[observations.num_views].set(row), observations.poses, pose)
    empty: Bool[Array, "g g g"] | None = observations.seen_empty
    if carving is not None and empty is not None and observations.grid is not None:
        barrier = None if obstacles is None else obstacles.barrier(camera, pose)
        empty = empty | carving.seen_empty(observations.grid, pose, scan, camera, barrier)
    return dataclasses.replace(observations, poses=poses, num_views=observations.num_views + 1, seen_empty=empty)


@eqx.filter_jit
def _sample(
    sampler: SurfaceSampler, observations: Observations, key: PRNGKeyArray, posterior: SurfacePosterior
) -> GridSurface:
    fields = posterior.sample(key, sampler.num_samples)
    values = fields.on_grid(sampler.grid.axis) - posterior.level
    return GridSurface.from_values(sampler.carve(observations, values), 0.0, sampler.grid)
