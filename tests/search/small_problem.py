"""A small problem of one step (three balls as samples, a few points, twelve candidates), and its scores by loops."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from on_grid import balls

import jaxnbv as nbv
from jaxnbv.geometry.pose_list import PoseList
from jaxnbv.sampler import StepInputs

CAMERA, POSES, KEY = nbv.Camera(height=8, width=8), nbv.SphereCandidates(12).poses(), jax.random.key(5)


def problem_of(surfaces, acquisition=nbv.Coverage(), camera=CAMERA):  # noqa: B008
    """A problem with room for six views, and none so far."""
    rng = np.random.default_rng(0)
    cloud = nbv.PointCloud.from_arrays(rng.uniform(-1, 1, (30, 3)), np.tile([0.0, 1.0, 0.0], (30, 1)), 32)
    inputs = StepInputs(nbv.Observations.start(cloud, 6), None, surfaces)
    return nbv.search.Problem(inputs, camera, acquisition).prepared()


@functools.cache
def three_balls():
    rng = np.random.default_rng(0)
    return problem_of(balls(nbv.Grid(20), (0.8, 0.6, 0.9), rng.uniform(-0.5, 0.5, (3, 3))))


def visit(problem, *poses):
    """The problem after views from exactly these poses."""
    if not poses:
        return problem
    pose_list = PoseList.empty(6)
    for pose in poses:
        pose_list = pose_list.append(pose)
    return eqx.tree_at(lambda p: p.inputs.observations.poses, problem, pose_list)


@eqx.filter_jit
def propose(search, problem, key=KEY):
    return search.propose(problem, key)


def with_samples(problem, rows):
    return eqx.tree_at(lambda p: p.inputs.surfaces, problem, jax.tree.map(lambda leaf: leaf[rows], problem.surfaces))


def sample_by_sample(problem, acquisition=nbv.Coverage(), poses=POSES):  # noqa: B008
    """Scores (samples, candidates), computed sample by sample."""
    value = eqx.filter_jit(nbv.expected_value)
    of = [
        value(acquisition, problem.observations.cloud, with_samples(problem, slice(s, s + 1)).surfaces, CAMERA, poses)
        for s in range(problem.num_samples)
    ]
    return np.array(of, np.float64)


class Height(nbv.Acquisition):
    """Height of the mean point of a scan, times a factor."""

    factor: float = 1.0

    def context(self, step):
        return None

    def score(self, context, view):
        scan = view.scan
        return self.factor * jnp.sum(jnp.where(scan.mask, scan.points[:, 1], 0.0)) / jnp.maximum(scan.count, 1)


class Constant(nbv.Acquisition):
    """An acquisition with the same value for all scans."""

    value: float

    def context(self, step):
        return None

    def score(self, context, view):
        return jnp.asarray(self.value)
