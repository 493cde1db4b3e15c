"""Simple classifiers in JAX and NumPy, a segmenter, and clouds for them."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxnbv as nbv
from jaxnbv.acquisition import ImaginedView, inputs_of
from jaxnbv.tasks import Segmenter

WEIGHTS = np.random.default_rng(7).normal(size=(4, 6)) * 3.0


def linear(cloud):
    """Log-probabilities of four classes, from the means of the points and of the normals."""
    rows = jnp.concatenate([cloud.points, cloud.normals], axis=-1)
    mean = jnp.sum(jnp.where(cloud.mask[:, None], rows, 0.0), axis=0) / jnp.maximum(cloud.count, 1)
    return jax.nn.log_softmax(jnp.asarray(WEIGHTS, mean.dtype) @ mean)


def linear_in_numpy(points, normals):
    mean = np.concatenate([points, normals], axis=-1).astype(np.float64).mean(axis=0)
    p = np.exp(WEIGHTS @ mean)
    return p / p.sum()


def linear_of_batch(points, normals, mask):
    """`linear` for a batch, as the host calls it."""
    return np.log([linear_in_numpy(p[m], n[m]) for p, n, m in zip(points, normals, mask, strict=True)])


def drawn_cloud(rng, count, capacity, center=(0.0, 0.0, 0.0)):
    normals = rng.normal(size=(count, 3))
    points = np.asarray(center) + 0.5 * rng.normal(size=(count, 3))
    return nbv.PointCloud.from_arrays(points, normals / np.linalg.norm(normals, axis=1, keepdims=True), capacity)


def nothing(capacity):
    return nbv.PointCloud(jnp.zeros((capacity, 3)), jnp.zeros((capacity, 3)), jnp.zeros(capacity, bool))


def context_of(acquisition, cloud):
    """The acquisition's context for a cloud, not compiled."""
    return acquisition.context(inputs_of(cloud))


def score_of(acquisition, context, scan):
    """The score of a scan by an acquisition that does not depend on the scan's pose."""
    return acquisition.score(context, ImaginedView(scan, nbv.Camera(height=2, width=2), nbv.look_at((0.0, 0.0, 2.5))))


class Linear(Segmenter):
    """Probabilities of parts from the point's position and normal."""

    weight: jax.Array

    def __call__(self, cloud):
        features = jnp.concatenate([cloud.points, cloud.normals], axis=-1)
        return jnp.where(cloud.mask[:, None], jax.nn.softmax(features @ self.weight, axis=-1), 0.0)
