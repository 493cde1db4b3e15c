"""The oracle of these tests: the surface prior as a Bayesian linear regression in weight space, in NumPy float64.

Over the half H of the integer lattice whose first nonzero component is positive, and with w_d ~ N(0, I),

    v_d(x) = sqrt(s(0)) w_d0 + sum_{n in H} sqrt(2 s(n)) (w_dn cos(n.x) + w'_dn sin(n.x)),   f(x) = sum_d Psi_d(x) w_d

where Psi_d solves Laplacian f = dv_d/dx_d mode by mode. It shares no code, basis or kernel with the package. The module
also has clouds for the tests.
"""

import functools
import math

import jax.numpy as jnp
import numpy as np

import jaxnbv as nbv


def cloud(points, normals, capacity=None, dtype=None):
    """A cloud with normals of any length. `from_arrays` would scale them to unit length."""
    pad = ((0, (capacity or len(points)) - len(points)), (0, 0))
    arrays = (jnp.asarray(np.pad(a, pad), dtype) for a in (points, normals))
    return nbv.PointCloud(*arrays, jnp.arange(capacity or len(points)) < len(points))


def ball(rng, count):
    """Points of a ball of radius 0.7, in a cloud with spare rows."""
    points = rng.standard_normal((count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return nbv.PointCloud.from_arrays(0.7 * points, points, capacity=count + 16)


@functools.cache
def lattice_spectrum(nu, lengthscale, variance, truncation):
    """s1(0), ..., s1(L). The normalising sum is term by term to 10^6, and beyond by the midpoint rule."""
    terms, power = 10**6, nu + 0.5
    weight = (2 * nu / lengthscale**2 + (2 * np.pi * np.arange(terms + 1.0)) ** 2) ** -power
    tail = (2 * np.pi) ** (-2 * power) * (terms + 0.5) ** (1 - 2 * power) / (2 * power - 1)
    return variance * weight[: truncation + 1] / (weight[0] + 2 * weight[1:].sum() + 2 * tail)


def lattice(truncation):
    axis = np.arange(-truncation, truncation + 1)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


class WeightSpace:
    def __init__(self, lengthscale=0.1, variance=1.0, noise=0.1, nu=1.5, truncation=4):
        spectrum = lattice_spectrum(nu, lengthscale, variance, truncation)
        n = lattice(truncation)
        half = (n[:, 0] > 0) | ((n[:, 0] == 0) & ((n[:, 1] > 0) | ((n[:, 1] == 0) & (n[:, 2] > 0))))
        self.n = n[half]
        self.amplitude = np.sqrt(2 * spectrum[np.abs(self.n)].prod(axis=1))
        self.constant = math.sqrt(spectrum[0] ** 3)
        self.noise = noise

    @property
    def num_weights(self):
        return 2 * len(self.n) + 1

    def normal_features(self, x):
        """(n, k): v_d = features @ w_d."""
        angle = x @ self.n.T
        constant = np.full((len(x), 1), self.constant)
        return np.concatenate([constant, self.amplitude * np.cos(angle), self.amplitude * np.sin(angle)], axis=1)

    def function_features(self, x):
        """(3, n, k): f = sum_d features_d @ w_d."""
        angle = x @ self.n.T
        scale = self.amplitude * self.n.T / (self.n**2).sum(axis=1)
        zero = np.zeros((3, len(x), 1))
        return np.concatenate([zero, scale[:, None] * np.sin(angle), -scale[:, None] * np.cos(angle)], axis=2)

    def condition(self, points, normals):
        """Mean (3, k) and covariance (k, k) of the weights, the same covariance for each component."""
        features = self.normal_features(points)
        precision = np.eye(self.num_weights) + features.T @ features / self.noise**2
        covariance = np.linalg.inv(precision)
        return (covariance @ features.T @ normals / self.noise**2).T, covariance

    def posterior(self, points, normals, x):
        """Mean (n,) and covariance (n, n) of f(x)."""
        mean, covariance = self.condition(points, normals)
        features = self.function_features(x)
        return np.einsum("dnk,dk->n", features, mean), sum(g @ covariance @ g.T for g in features)

    def log_marginal_likelihood(self, points, normals):
        features = self.normal_features(points)
        covariance = features @ features.T + self.noise**2 * np.eye(len(points))
        fit = np.sum(normals * np.linalg.solve(covariance, normals))
        return -0.5 * fit - 1.5 * np.linalg.slogdet(2 * np.pi * covariance)[1]


class JointWeightSpace:
    """Normals and values in one regression: weights of all three components and of the level c, which the values
    couple.

    `scales` are `WeightSpace`s of independent priors, which are added. g = f - c, c ~ N(0, level_deviation^2).
    """

    def __init__(self, scales, level_deviation):
        self.scales, self.level_deviation = scales, level_deviation

    def function_features(self, x):
        """(n, k): g = features @ w."""
        parts = [np.concatenate(list(scale.function_features(x)), axis=1) for scale in self.scales]
        return np.concatenate([*parts, np.full((len(x), 1), -self.level_deviation)], axis=1)

    def normal_features(self, x):
        """(3 n, k): the three components of v one after the other."""
        parts = [np.kron(np.eye(3), scale.normal_features(x)) for scale in self.scales]
        return np.concatenate([*parts, np.zeros((3 * len(x), 1))], axis=1)

    def posterior(self, data, x):
        """Mean (n,) and covariance (n, n) of g(x), by the joint covariance of all observations.

        `data`: points, normals, their noise, and points, values and noise (m,) of the values.
        """
        points, normals, noise, at, values, value_noise = data
        features = np.concatenate([self.normal_features(points), self.function_features(at)])
        observed = np.concatenate([normals.T.reshape(-1), values])
        covariance = features @ features.T
        covariance += np.diag(np.concatenate([np.full(normals.size, noise**2), value_noise**2]))
        queries = self.function_features(x)
        cross = queries @ features.T
        mean = cross @ np.linalg.solve(covariance, observed)
        explained = cross @ np.linalg.solve(covariance, cross.T)
        return mean, queries @ queries.T - explained
