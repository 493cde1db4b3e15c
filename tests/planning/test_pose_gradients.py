"""Derivatives of the acquisitions in the camera's pose, against central differences in double precision.

The derivative is pathwise: every ray stays on the part of the surface that it hits. Where a ray leaves the surface, or
moves to another part of it, the value jumps, and the derivative does not include that. Where a ray grazes the surface
the derivative is bounded, and where a hit moves to another cell of the grid it has a kink. The tests detect such pairs
of a pose and a direction, count them, and compare all others.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from on_grid import nodes
from scipy.ndimage import gaussian_filter, map_coordinates

from jaxnbv.acquisition import Acquisition, ExpectedUtilityImprovement, expected_value
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose, fibonacci_sphere, look_at
from jaxnbv.networks import CloudClassifier, InvariantClassifier
from jaxnbv.scanning import Grid, GridSurface, scan_samples
from jaxnbv.search import FreePoses, SpherePoses
from jaxnbv.tasks import Coverage
from jaxnbv.tasks.classification import CrossEntropy, EntropyReduction, MixedEntropy

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


ACQUISITIONS = {
    "coverage": Coverage(),
    "cross-entropy": CrossEntropy(smooth),
    "mixed, open": MixedEntropy(smooth, threshold=0.0),
    "mixed, settled": MixedEntropy(smooth, threshold=9.0),
    "entropy": EntropyReduction(smooth),
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


class Pairs(NamedTuple):
    """Starts, parameters and directions of the pairs. Each start has a row of parameters and some directions."""

    starts: Pose
    parameters: np.ndarray
    directions: np.ndarray

    def moved(self, step):
        """Poses of all pairs at a step along their directions, as one batch."""
        far = self.parameters[:, None] + step * self.directions
        starts = jax.tree.map(lambda leaf: jnp.repeat(leaf, far.shape[1], axis=0), self.starts)
        return jax.jit(jax.vmap(move))(starts, jnp.asarray(far.reshape(-1, NUM_SPHERE + NUM_FREE)))


def pairs_of(space, count=15):
    """Poses around the object: on the sphere, or off it with an axis that misses the centre."""
    rng = np.random.default_rng(11)
    positions = np.asarray(fibonacci_sphere(count, 2.5)) + rng.uniform(-0.1, 0.1, (count, 3))
    parameters = np.zeros((count, NUM_SPHERE + NUM_FREE))
    directions = rng.normal(size=(count, NUM_DIRECTIONS, NUM_SPHERE + NUM_FREE))
    if space == "sphere":
        directions[..., NUM_SPHERE:] = 0.0
    else:
        directions[..., :NUM_SPHERE] = 0.0
        parameters[:, NUM_SPHERE:] = 0.1 * rng.normal(size=(count, NUM_FREE))
    return Pairs(look_at(positions), parameters, directions / np.linalg.norm(directions, axis=-1, keepdims=True))


class Events(NamedTuple):
    """Whether, for each pair, a ray jumps or changes its cell between the two ends of a step, or grazes at one end."""

    jumps: np.ndarray
    crosses: np.ndarray
    grazes: np.ndarray

    @property
    def none(self):
        return ~(self.jumps | self.crosses | self.grazes)


def events(surfaces, pairs, step):
    ends = [scan_samples(surfaces, CAMERA, pairs.moved(sign * step)) for sign in (1, -1)]
    masks, points = zip(*[(np.asarray(end.mask), np.asarray(end.points)) for end in ends], strict=True)
    both = masks[0] & masks[1]
    # A hit that does not jump moves by at most 34 times as much as its ray, which moves by three times the step.
    jumps = (masks[0] != masks[1]) | (both & (np.linalg.norm(points[0] - points[1], axis=-1) > 200 * step))
    places = [(p + GRID.half_extent) / GRID.spacing for p in points]
    crosses = both & (np.floor(places[0]) != np.floor(places[1])).any(axis=-1)
    rays = points[0] - np.asarray(pairs.moved(step).position)[None, :, None]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    grazes = np.stack([grazing(np.asarray(f), u, d) for f, u, d in zip(surfaces.values, places[0], rays, strict=True)])
    return Events(*(event.any(axis=(0, 2)) for event in (jumps, crosses, both & grazes)))


def grazing(values, places, directions):
    """Whether the slope of the interpolant along a ray is below 0.03 of its spread over the cell."""
    ahead, behind = (
        map_coordinates(values, np.moveaxis(places + sign * 1e-6 * directions, -1, 0), order=1) for sign in (1, -1)
    )
    cell = np.clip(np.floor(places).astype(int), 0, GRID.resolution - 2)
    corners = np.stack([values[tuple(np.moveaxis(cell + offset, -1, 0))] for offset in np.ndindex(2, 2, 2)])
    return np.abs(ahead - behind) / 2e-6 < 0.03 * np.ptp(corners, axis=0)


def random_cloud():
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud.from_arrays(0.5 * normals + 0.1 * rng.normal(size=(30, 3)), normals, 32)


def compare(score, surfaces, pairs, step=STEP):
    """Derivatives along the pairs' directions, central differences, and lengths of the gradients."""
    cloud = random_cloud()
    slope = np.asarray(slopes_at(score, cloud, surfaces, pairs.starts, jnp.asarray(pairs.parameters)))
    assert np.isfinite(slope).all()
    derivatives = np.einsum("pdk,pk->pd", pairs.directions, slope).ravel()
    ahead, behind = (values_at(score, cloud, surfaces, pairs.moved(sign * step)) for sign in (1, -1))
    # The gradient in the parameters that the directions change.
    length = np.linalg.norm(np.where((pairs.directions != 0).any(axis=1), slope, 0.0), axis=-1)
    return derivatives, np.asarray(ahead - behind) / (2 * step), np.repeat(length, pairs.directions.shape[1])


@pytest.mark.parametrize(
    ("kind", "space"),
    [
        ("blob", "sphere"),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (("filling", "sphere"), ("rough", "free"))),
    ],
)
def test_derivatives_are_those_of_central_differences(kind, space, x64):
    surfaces, pairs = surfaces_of(kind), pairs_of(space)
    event = events(surfaces, pairs, STEP)
    counts = np.asarray(scan_samples(surfaces, CAMERA, pairs.moved(0.0)).count)
    if kind == "filling" and space == "sphere":
        assert (counts == CAMERA.num_rays).all()
        assert not event.grazes.any()
    if kind != "filling":
        assert (counts < CAMERA.num_rays).all()
    assert event.jumps.mean() < 0.03
    assert event.crosses.mean() < 0.03
    assert event.grazes.mean() < 0.3
    weights = jnp.eye(len(ACQUISITIONS))
    for name, weight in zip(ACQUISITIONS, weights, strict=True):
        derivatives, expected, length = compare(OneOf(list(ACQUISITIONS.values()), weight), surfaces, pairs)
        error = np.abs(derivatives - expected)
        worst = np.max((error / (1e-6 * length + 1e-7))[event.none])
        assert worst < 1, f"{name}: {worst:.3g} times the tolerance"
        assert (length[event.none] > 1e-3).mean() > 0.5, f"{name} has no slope"


def test_a_jump_is_not_in_the_derivative(x64):
    """Silhouettes pass over some pixels within a step of a thousandth, and differences are much larger there."""
    surfaces, pairs, step = surfaces_of("blob"), pairs_of("free"), 1e-3
    event = events(surfaces, pairs, step)
    weight = jnp.eye(len(ACQUISITIONS))[0]
    derivatives, expected, length = compare(OneOf(list(ACQUISITIONS.values()), weight), surfaces, pairs, step)
    error = np.abs(derivatives - expected) / length
    assert 0.0 < event.jumps.mean() < 0.2
    assert np.median(error[event.jumps]) > 30 * np.median(error[~event.jumps & ~event.grazes])


@pytest.mark.slow
def test_derivatives_through_a_network(x64):
    """A network has kinks where a unit switches and where it picks other points. Almost everywhere the two agree."""
    network = CloudClassifier(InvariantClassifier(3, jax.random.key(0)), 96)
    surfaces, pairs = surfaces_of("blob"), pairs_of("free", 6)
    event = events(surfaces, pairs, STEP)
    derivatives, expected, length = compare(CrossEntropy(network), surfaces, pairs)
    error = (np.abs(derivatives - expected) / length)[event.none]
    assert event.none.mean() > 0.5
    assert np.median(error) < 1e-5
    assert error.max() < 1e-2
