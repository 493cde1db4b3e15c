"""A user's own surface model, with any sampler, drives the planner and the simulated episode."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Cuboid, Sphere


class SphereFields(nbv.surfaces.Fields):
    centres: Float[Array, "s 3"]
    radii: Float[Array, " s"]

    def __call__(self, x):
        return jnp.linalg.norm(x[None] - self.centres[:, None], axis=-1) - self.radii[:, None]


class SpherePosterior(nbv.surfaces.SurfacePosterior):
    level: Float[Array, ""]
    cloud: nbv.PointCloud

    def sample(self, key, num_samples):
        radii = jax.random.uniform(key, (num_samples,), minval=0.5, maxval=0.9)
        centres = self.cloud.points - radii[:, None, None] * self.cloud.normals
        return SphereFields(jnp.mean(centres, axis=1, where=self.cloud.mask[:, None]), radii)


class RandomSpheres(nbv.SurfaceModel):
    def condition(self, observations):
        return SpherePosterior(jnp.asarray(0.0), nbv.as_observations(observations).cloud)


CAMERA = nbv.Camera(height=16, width=16)
BALL, BOX = nbv.SDFSurface(Sphere(0.7)), nbv.SDFSurface(Cuboid([0.5, 0.6, 0.4]))


def planner():
    sampler = nbv.SurfaceSampler(RandomSpheres(), grid=nbv.Grid(40), num_samples=3)
    return nbv.Planner(nbv.Coverage(), nbv.DiscreteSearch(12), CAMERA, sampler, capacity=512, max_views=4)


@pytest.mark.slow
def test_proposed_view_is_the_best_by_chamfer_distance_to_exact_scans_of_the_samples():
    """Each sample is a sphere. Its scan in closed form gives the mean over samples of the sum of squared distances."""
    plan, key = planner(), jax.random.key(1)
    first = nbv.look_at((0.8, 0.9, 2.2))
    cloud = nbv.scan(BALL, CAMERA, first)
    observations = plan.init(first, cloud)
    proposal = plan.propose(observations, key)
    sample_key, _ = jax.random.split(key)
    fields = RandomSpheres().condition(observations).sample(sample_key, 3)
    points, _ = cloud.to_numpy()
    values = np.zeros(12)
    for i, pose in enumerate(nbv.look_at(nbv.geometry.fibonacci_sphere(12, 2.5))[j] for j in range(12)):
        origins, directions = (np.asarray(a, np.float64) for a in CAMERA.rays(pose))
        for centre, radius in zip(np.asarray(fields.centres), np.asarray(fields.radii), strict=True):
            along = np.sum(directions * (centre - origins), axis=1)
            inside = along**2 - np.sum((centre - origins) ** 2, axis=1) + radius**2
            t = along - np.sqrt(np.maximum(inside, 0))
            hits = (origins + t[:, None] * directions)[inside > 0]
            values[i] += np.min(np.sum((hits[:, None] - points) ** 2, axis=-1), axis=1).sum() / 3
    np.testing.assert_allclose(proposal.values, values, rtol=0.03, atol=0.03 * values.max())
    assert int(np.argmax(proposal.values)) == int(np.argmax(values))
    np.testing.assert_allclose(
        proposal.pose.position, nbv.geometry.fibonacci_sphere(12, 2.5)[np.argmax(values)], atol=1e-6
    )


def test_a_simulated_episode_sees_a_box_by_spheres():
    first = nbv.look_at((0.8, 0.9, 2.2))
    noise = nbv.SensorNoise(0.0, 0.0)
    episode = nbv.simulate(planner(), BOX, first, 3, jax.random.key(0), noise, progress=False)
    assert len(episode.views) == 3
    points, _ = episode.cloud.to_numpy()
    distance = np.asarray(BOX.sdf(jnp.asarray(points)))
    assert len(points) > len(episode.views[0].scan.to_numpy()[0])
    assert np.abs(distance).max() < 1e-3
    positions = np.array([view.pose.position for view in episode.views])
    assert np.linalg.norm(positions[:, None] - positions, axis=-1)[np.triu_indices(3, 1)].min() > 0.5
