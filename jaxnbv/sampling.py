"""The surfaces that a step imagines: samples of the posterior, carved.

What is compiled takes what it uses, not the planner: another score or search does not compile the sampler again.
"""

import equinox as eqx
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.scanning import Carving, Grid, GridSurface, carve
from jaxnbv.scanning.surroundings import Surroundings
from jaxnbv.surfaces import SurfaceModel, SurfacePosterior


def posterior_of(
    model: SurfaceModel, carving: Carving | None, grid: Grid, cloud: PointCloud, empty: Bool[Array, "g g g"] | None
) -> SurfacePosterior:
    """p(f | D, what was seen empty); given D alone without carving."""
    if carving is None or empty is None:
        return model.condition(cloud)
    return model.condition_on_space(cloud, carving.empty_points(grid, empty))


def carved(
    carving: Carving | None,
    grid: Grid,
    surroundings: Surroundings | None,
    empty: Bool[Array, "g g g"] | None,
    values: Float[Array, "*s g g g"],
) -> Float[Array, "*s g g g"]:
    """Values of f minus its level at the grid's nodes, made positive where the object cannot be: in space that was seen
    empty, outside its volume, and within obstacles."""
    if carving is None or empty is None:
        return values
    elsewhere = empty | carving.outside(grid)
    return carve(values, elsewhere if surroundings is None else elsewhere | surroundings.within(grid))


@eqx.filter_jit
def sample_surfaces(
    model: SurfaceModel,
    carving: Carving | None,
    grid: Grid,
    surroundings: Surroundings | None,
    num_samples: int,
    cloud: PointCloud,
    empty: Bool[Array, "g g g"] | None,
    key: PRNGKeyArray,
    posterior: SurfacePosterior | None,
) -> GridSurface:
    """Samples of the surface given D, carved."""
    posterior = posterior_of(model, carving, grid, cloud, empty) if posterior is None else posterior
    values = posterior.sample(key, num_samples).on_grid(grid.axis) - posterior.level
    return GridSurface.from_values(carved(carving, grid, surroundings, empty, values), 0.0, grid)
