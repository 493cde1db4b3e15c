"""Derivatives of the acquisitions in the camera's pose, against central differences in double precision.

The derivative is pathwise: every ray stays on the part of the surface that it hits. Where a ray leaves the surface, or
moves to another part of it, the value jumps, and the derivative does not include that. Where a ray grazes the surface,
or a hit moves to another cell of the grid, differences are inaccurate too. In these scenes that concerns less than a
third of the directions, and hardly any on the sphere about an object that fills the image.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from on_grid import nodes
from scipy.ndimage import gaussian_filter

from jaxnbv.acquisition import Acquisition, ExpectedUtilityImprovement, expected_value
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import fibonacci_sphere, look_at
from jaxnbv.networks import CloudClassifier, InvariantClassifier
from jaxnbv.scanning import Grid, GridSurface
from jaxnbv.search import FreePoses, SpherePoses
from jaxnbv.tasks import Coverage
from jaxnbv.tasks.classification import CrossEntropy, MixedEntropy

CAMERA, GRID, STEP = Camera(height=8, width=8), Grid(26), 1e-6
NUM_DIRECTIONS, NUM_SPHERE, NUM_FREE = 3, 3, 9


def smooth(cloud):
    """Log-probabilities of three classes from averages of smooth features."""
    rows = jnp.concatenate([cloud.points, cloud.normals], axis=-1)
    weights = jnp.asarray(np.random.default_rng(4).normal(size=(6, 8)))
    features = jnp.where(cloud.mask[:, None], jnp.tanh(rows @ weights), 0.0)
    head = jnp.asarray(np.random.default_rng(5).normal(size=(8, 3)))
    return jax.nn.log_softmax(6.0 * (jnp.sum(features, axis=0) / cloud.count) @ head)


def spread(cloud):
    """A utility: log det of the second moments of points and normals."""
    rows = jnp.where(cloud.mask[:, None], jnp.concatenate([cloud.points, cloud.normals], axis=-1), 0.0)
    return jnp.linalg.slogdet(0.1 * jnp.eye(6) + rows.T @ rows)[1]


# `MixedEntropy` is the cross-entropy, or the reduction of entropy.
ACQUISITIONS = {
    "coverage": Coverage(),
    "mixed, open": MixedEntropy(smooth, threshold=0.0),
    "mixed, settled": MixedEntropy(smooth, threshold=9.0),
    "custom": ExpectedUtilityImprovement(spread),
}


class OneOf(Acquisition):
    """One of several acquisitions, selected by a weight, so that all share one compilation."""

    members: list[Acquisition]
    weights: jax.Array

    def context(self, step):
        return [member.context(step) for member in self.members]

    def score(self, context, view):
        values = [member.score(c, view) for member, c in zip(self.members, context, strict=True)]
        return jnp.stack(values) @ self.weights


def surfaces_of(kind):
    """Two samples by their values at nodes: balls that fill the image, blobs within the image, and rough fields with
    holes."""
    rng = np.random.default_rng(["filling", "blob", "rough"].index(kind))
    x = nodes(GRID.axis)
    radius, height = {"filling": (1.1, 0.3), "blob": (0.6, 0.5), "rough": (0.5, 2.5)}[kind]
    noise = gaussian_filter(rng.normal(size=(2, *x.shape[:3])), (0, 2.5, 2.5, 2.5))
    noise *= 0.1 / noise.std()
    return GridSurface.from_values(jnp.asarray(np.linalg.norm(x, axis=-1) - radius + height * noise), 0.0, GRID)


def move(start, parameters):
    """A pose that moves on the sphere by the first parameters, and then freely by the others."""
    return FreePoses().retract(SpherePoses().retract(start, parameters[:NUM_SPHERE]), parameters[NUM_SPHERE:])


@eqx.filter_jit
def values_at(score, cloud, surfaces, poses):
    return expected_value(score, cloud, surfaces, CAMERA, poses)


@eqx.filter_jit
def slopes_at(score, cloud, surfaces, starts, parameters):
    def total(parameters):
        return jnp.sum(expected_value(score, cloud, surfaces, CAMERA, jax.vmap(move)(starts, parameters)))

    return jax.grad(total)(parameters)


def starts_of(space, count=15):
    """Poses around the object, parameters and directions: on the sphere, or off it with an axis that misses the
    centre."""
    rng = np.random.default_rng(11)
    positions = np.asarray(fibonacci_sphere(count, 2.5)) + rng.uniform(-0.1, 0.1, (count, 3))
    parameters = np.zeros((count, NUM_SPHERE + NUM_FREE))
    directions = rng.normal(size=(count, NUM_DIRECTIONS, NUM_SPHERE + NUM_FREE))
    if space == "sphere":
        directions[..., NUM_SPHERE:] = 0.0
    else:
        directions[..., :NUM_SPHERE] = 0.0
        parameters[:, NUM_SPHERE:] = 0.1 * rng.normal(size=(count, NUM_FREE))
    return look_at(positions), parameters, directions / np.linalg.norm(directions, axis=-1, keepdims=True)


@jax.jit
def moved(starts, parameters):
    """Poses at all parameters (starts, directions, numbers), as one batch."""
    repeated = jax.tree.map(lambda leaf: jnp.repeat(leaf, parameters.shape[1], axis=0), starts)
    return jax.vmap(move)(repeated, parameters.reshape(-1, NUM_SPHERE + NUM_FREE))


def compare(score, surfaces, starts, parameters, directions):
    """Derivatives along the directions, central differences, and lengths of the gradients."""
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = PointCloud.from_arrays(0.5 * normals + 0.1 * rng.normal(size=(30, 3)), normals, 32)
    slope = np.asarray(slopes_at(score, cloud, surfaces, starts, jnp.asarray(parameters)))
    assert np.isfinite(slope).all()
    ends = [jnp.asarray(parameters[:, None] + sign * STEP * directions) for sign in (1, -1)]
    ahead, behind = (values_at(score, cloud, surfaces, moved(starts, end)) for end in ends)
    # The gradient in the parameters that the directions change.
    length = np.linalg.norm(np.where((directions != 0).any(axis=1), slope, 0.0), axis=-1)
    derivatives = np.einsum("pdk,pk->pd", directions, slope).ravel()
    return derivatives, np.asarray(ahead - behind) / (2 * STEP), np.repeat(length, directions.shape[1])


@pytest.mark.parametrize(
    ("kind", "space"),
    [
        ("blob", "sphere"),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (("filling", "sphere"), ("rough", "free"))),
    ],
)
def test_derivatives_are_those_of_central_differences(kind, space, x64):
    surfaces, pairs = surfaces_of(kind), starts_of(space)
    for name, weight in zip(ACQUISITIONS, jnp.eye(len(ACQUISITIONS)), strict=True):
        derivatives, expected, length = compare(OneOf(list(ACQUISITIONS.values()), weight), surfaces, *pairs)
        error = np.abs(derivatives - expected) / (1e-6 * length + 1e-7)
        assert np.quantile(error, 0.94 if kind == "filling" else 0.66) < 1, f"{name}: {np.sort(error)}"
        assert (length > 1e-3).mean() > 0.5, f"{name} has no slope"


@pytest.mark.slow
def test_derivatives_through_a_network(x64):
    """A network has kinks where a unit switches and where it picks other points. Almost everywhere the two agree."""
    network = CloudClassifier(InvariantClassifier(3, jax.random.key(0)), 96)
    derivatives, expected, length = compare(CrossEntropy(network), surfaces_of("blob"), *starts_of("free", 6))
    error = np.abs(derivatives - expected) / length
    assert np.median(error) < 1e-5
    assert np.quantile(error, 0.66) < 1e-2
