"""Hyperparameters from the data: the lengthscale, variance and noise under which the normals are most likely."""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.checks import check_key, check_type, checked, require
from jaxnbv.geometry.cloud import PointCloud, check_oriented
from jaxnbv.surfaces.base import HALF_WIDTH
from jaxnbv.surfaces.screened import ScreenedSPSR
from jaxnbv.surfaces.spsr import GeometricSPSR

Model = TypeVar("Model", GeometricSPSR, ScreenedSPSR)

_TOLERANCE = 3e-3


@checked
def fit_hyperparameters(
    model: Model, cloud: PointCloud, key: PRNGKeyArray, num_points: int = 400, max_steps: int = 60
) -> Model:
    """The model with the lengthscale, variance and noise that maximise log p(normals | points), from its own on.

    BFGS on their logarithms, over `num_points` of the points drawn at random (all of them, where there are fewer): a
    random choice keeps near neighbours, which farthest points would not, and without which a short lengthscale cannot
    be told. Of a `ScreenedSPSR` the base is fitted; its values follow by themselves, being in units of the data's jump.

    The maximum is a local one. It explains the scanned patch, and says little about what was not seen: prefer the fixed
    values where the patch is flat, and the fitted ones where the surface has detail of another size than they expect.

    **Raises:** `ValueError` for a cloud as `condition` does, `num_points` < 8, `max_steps` < 1, or if no
    likelihood that is finite was found.
    """
    check_type(model, GeometricSPSR | ScreenedSPSR, "the model")
    check_key(key)
    require(num_points >= 8, f"asked for {num_points} points to fit to; ask for at least 8")
    require(max_steps >= 1, f"asked for {max_steps} steps; ask for at least one")
    check_oriented(cloud, "the cloud", HALF_WIDTH, unit=False)
    base = model.base if isinstance(model, ScreenedSPSR) else model
    found: GeometricSPSR
    found, likelihood = _fit(base, _random_rows(cloud, key, num_points), max_steps)
    require(
        all(bool(jnp.isfinite(value).all()) for value in (likelihood, *_parameters(found))),
        "the likelihood of the normals is not finite: start from a model of more noise, or enable jax_enable_x64",
    )
    # Made anew, so that a truncation that no longer fits the lengthscale is warned of.
    found = _with(base, _parameters(found))
    return eqx.tree_at(lambda m: m.base, model, found) if isinstance(model, ScreenedSPSR) else found


def _random_rows(cloud: PointCloud, key: PRNGKeyArray, count: int) -> PointCloud:
    order = jnp.argsort(jnp.where(cloud.mask, jax.random.uniform(key, cloud.mask.shape), jnp.inf))[:count]
    return PointCloud(cloud.points[order], cloud.normals[order], cloud.mask[order])


@eqx.filter_jit
def _fit(model: GeometricSPSR, cloud: PointCloud, max_steps: int) -> tuple[GeometricSPSR, Float[Array, ""]]:
    """The fitted model, and its likelihood."""

    def with_logarithms(logarithms) -> GeometricSPSR:
        return _with(model, jax.tree.map(jnp.exp, logarithms))

    def loss(logarithms, _):
        likelihood = with_logarithms(logarithms).factorised(cloud).log_marginal_likelihood()
        return -likelihood / cloud.count

    start = jax.tree.map(jnp.log, _parameters(model))
    solver: Any = optx.BFGS(rtol=_TOLERANCE, atol=_TOLERANCE)
    solution: Any = optx.minimise(loss, solver, start, max_steps=max_steps, throw=False)
    found = with_logarithms(solution.value)
    return found, found.factorised(cloud).log_marginal_likelihood()


def _parameters(model: GeometricSPSR):
    return model.lengthscale, model.variance, model.noise


def _with(model: GeometricSPSR, parameters) -> GeometricSPSR:
    lengthscale, variance, noise = parameters
    return GeometricSPSR(lengthscale, variance, model.truncation, noise, model.nu)
