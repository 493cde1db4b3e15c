"""Functions give the same result for arrays of another byte order, or of longer types than JAX's: `python
byte_order.py`.

This is a program of its own, because in the tests beartype checks annotations before anything else.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import jaxnbv as nbv
from jaxnbv import sdf
from jaxnbv.scanning import GridSurface
from jaxnbv.surfaces import ValueRows

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(40, 3))
POINTS = (POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)).astype(np.float32)
CLOUD = nbv.PointCloud.from_arrays(POINTS, POINTS)
GRID = nbv.Grid(12)
POSTERIOR = nbv.GeometricSPSR(0.05, 0.2, 6).condition(CLOUD)
SAMPLES = POSTERIOR.sample(jax.random.key(0), 2)
SAMPLER = nbv.SurfaceSampler(nbv.GeometricSPSR(0.05, 0.2, 6), GRID, num_samples=2)
BALL = nbv.SDFSurface(sdf.Sphere(0.8))
SAMPLED = sdf.solid_of_mesh(*(lambda box: (box.vertices, box.faces))(nbv.mesh_from_sdf(sdf.Sphere(0.9), GRID)), 16)
VALUES = np.asarray(sdf.Sphere(0.7)(np.stack(np.meshgrid(*[GRID.axis] * 3, indexing="ij"), axis=-1)), np.float32)


class Shell(sdf.SignedDistance):
    """A user's own solid."""

    def __call__(self, x):
        return jnp.abs(jnp.linalg.norm(jnp.asarray(x), axis=-1) - 0.9) - 0.05


TAKES_POINTS = {
    "mean": POSTERIOR.mean,
    "variance": POSTERIOR.variance,
    "probability inside": POSTERIOR.probability_inside,
    "samples": SAMPLES,
    "gradients": SAMPLES.gradient,
    "a solid": sdf.Torus(0.8, 0.2) | sdf.Cuboid([0.5, 0.6, 0.7]),
    "a solid moved": sdf.Cuboid([0.5, 0.6, 0.7]).translate((0.1, 0.0, 0.0)).scale(1.5),
    "a solid on a grid": SAMPLED,
    "a solid of a user's": Shell(),
    "a box": nbv.Box(),
    "obstacles": nbv.Obstacles((sdf.Sphere(0.5),)).distance,
    "a frame": nbv.Frame.fit(2.0 * POINTS).to_scene,
    "inside": nbv.SDFSurface(sdf.Sphere(0.8).translate((0.5, 0.0, 0.0))).contains,
    "rays": lambda x: BALL.trace(2 * x, -x).points,
    "rays on a grid": lambda x: GridSurface.from_values(VALUES, 0.0, GRID).trace(2 * x, -x).points,
    "a cloud": lambda x: nbv.PointCloud(x, x, np.ones(len(x), bool)).only(np.ones(len(x), bool)).points,
    "a cloud that is conditioned on": lambda x: (
        nbv.GeometricSPSR(0.05, 0.2, 6).condition(nbv.PointCloud(x, x, np.ones(len(x), bool))).mean(POINTS)
    ),
    "values": lambda x: jax.jit(jnp.sum)(ValueRows(x, x[:, 0], x[:, 1] ** 2, np.ones(len(x), bool)).points),
    "poses": lambda x: nbv.Pose(np.broadcast_to(np.eye(3, dtype=x.dtype), (len(x), 3, 3)), x).position,
}


TAKES_VALUES = {
    "values to carve": lambda values: SAMPLER.carve(CLOUD, values),
    "a surface by its values": lambda values: (
        GridSurface.from_values(values, 0.0, GRID).trace(2 * POINTS, -POINTS).points
    ),
}


def different(function, array, kind):
    """Largest difference of the results, or the error that is raised instead."""
    try:
        expected, result = (np.asarray(function(numbers), float) for numbers in (array, array.astype(kind)))
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:150]}"
    apart = np.abs(expected - result).max()
    return None if apart < 1e-5 and (expected.ndim == 0 or np.ptp(expected) > 0) else f"{apart} apart"


def main() -> None:
    cases = [(TAKES_POINTS, POINTS), (TAKES_VALUES, VALUES)]
    problems = [
        f"{name}, {kind}: {problem}"
        for functions, array in cases
        for name, function in functions.items()
        for kind in (">f4", "longdouble")
        if (problem := different(function, array, kind))
    ]
    print("\n".join(problems))
    sys.exit(bool(problems))


if __name__ == "__main__":
    main()
