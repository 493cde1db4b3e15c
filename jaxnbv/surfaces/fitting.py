"""Hyperparameters from the data: the lengthscale, variance and noise under which the normals are most likely."""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import PRNGKeyArray

from jaxnbv.checks import checked, require
from jaxnbv.cloud import PointCloud
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

    **Raises:** `ValueError` if the cloud is empty, `num_points` < 8, or no likelihood that is finite was found.
    """
    require(num_points >= 8, f"asked for {num_points} points to fit to; ask for at least 8")
    base = model.base if isinstance(model, ScreenedSPSR) else model
    require(int(cloud.count) > 0, "cannot fit hyperparameters to an empty cloud: scan the object at least once")
    found = _fit(base, _random_rows(cloud, key, num_points), max_steps)
    require(
        all(bool(jnp.isfinite(value).all()) for value in (found.lengthscale, found.variance, found.noise)),
        "the likelihood of the normals is not finite: start from a model of more noise, or enable jax_enable_x64",
    )
    # Made anew, so that a truncation that no longer fits the lengthscale is warned of.
    found = _with(base, _parameters(found))
    return eqx.tree_at(lambda m: m.base, model, found) if isinstance(model, ScreenedSPSR) else found


def _random_rows(cloud: PointCloud, key: PRNGKeyArray, count: int) -> PointCloud:
    order = jnp.argsort(jnp.where(cloud.mask, jax.random.uniform(key, cloud.mask.shape), jnp.inf))[:count]
    return PointCloud(cloud.points[order], cloud.normals[order], cloud.mask[order])


@eqx.filter_jit
def _fit(model: GeometricSPSR, cloud: PointCloud, max_steps: int) -> GeometricSPSR:
    def with_logarithms(logarithms) -> GeometricSPSR:
        return _with(model, jax.tree.map(jnp.exp, logarithms))

    def loss(logarithms, _):
        likelihood = with_logarithms(logarithms).condition(cloud).log_marginal_likelihood()
        return -likelihood / cloud.count

    start = jax.tree.map(jnp.log, _parameters(model))
    solver: Any = optx.BFGS(rtol=_TOLERANCE, atol=_TOLERANCE)
    solution: Any = optx.minimise(loss, solver, start, max_steps=max_steps, throw=False)
    return with_logarithms(solution.value)


def _parameters(model: GeometricSPSR):
    return model.lengthscale, model.variance, model.noise


def _with(model: GeometricSPSR, parameters) -> GeometricSPSR:
    lengthscale, variance, noise = parameters
    return GeometricSPSR(lengthscale, variance, model.truncation, noise, model.nu)
