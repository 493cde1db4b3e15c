"""Whole episodes in one program equal those of `simulate`, one by one, to the last bit."""

import subprocess
import sys
import textwrap

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from small_planner import FIRST, planner_of

import jaxnbv as nbv
from jaxnbv.checks import InputError
from jaxnbv.scanning import GridSurface, mesh_from_sdf
from jaxnbv.scanning.sdf import Capsule, Cuboid, Sphere
from jaxnbv.surfaces import FreeRotation

# Without optimisation and with one LLVM module, XLA's rounding of a part depends on the rest of the module.
COMPUTES = True
BALLS = [Sphere(radius) | Capsule([0.2, 0.3, -0.4], [0.5, 0.6, 0.9], 0.3) for radius in (0.7, 0.8, 0.6)]
NODES = jnp.stack(jnp.meshgrid(*3 * [jnp.asarray(nbv.Grid(20).axis, jnp.float32)], indexing="ij"), axis=-1)
# The same balls by their values on a grid, with a leading axis.
VALUES = jnp.stack([ball(NODES) for ball in BALLS])
BATCH = GridSurface.from_values(VALUES, 0.0, nbv.Grid(20))
KEYS = jax.random.split(jax.random.key(7), 3)
POSES = nbv.look_at([(0.8, 0.9, 2.2), (0.8, -0.9, 2.2), (-2.0, 0.9, 1.0)])
COVERAGE, FARTHEST = planner_of(), planner_of(nbv.FarthestView(3))
NOISE = nbv.SensorNoise()


def by_height(cloud):
    """Two classes, by the mean height of the points."""
    height = jnp.sum(jnp.where(cloud.mask, cloud.points[:, 1], 0.0)) / jnp.maximum(cloud.count, 1)
    return jax.nn.log_softmax(jnp.stack([height, -height]))


def by_octant(cloud):
    """Parts by the largest coordinate of the point."""
    return jnp.where(cloud.mask[:, None], jax.nn.softmax(5.0 * cloud.points, axis=1), 0.0)


def one_by_one(planner, scenes, poses, views, keys, noise=NOISE):
    runs = zip(scenes, poses, keys, strict=True)
    return [nbv.simulate(planner, scene, pose, views, key, noise, progress=False) for scene, pose, key in runs]


def stacked(trees):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def assert_same_bits(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def assert_equal(together, alone, acquisition):
    values = [[np.nan if view.proposal is None else view.proposal.value for view in each.views] for each in alone]
    np.testing.assert_array_equal(together.values, np.asarray(values, np.float32))
    assert np.isnan(together.values[:, 0]).all()
    assert_same_bits(together.poses, stacked([stacked([view.pose for view in each.views]) for each in alone]))
    assert_same_bits(together.clouds, stacked([each.cloud for each in alone]))
    answers = [[view.answer(acquisition).values for view in each.views] for each in alone]
    np.testing.assert_array_equal(together.answers, np.asarray(answers, np.float32))


@pytest.mark.as_users
def test_episodes_are_those_of_simulate(compilations):
    """Poses, values, clouds and answers. The first pose is for each episode, or one for all. One program runs any
    number of views."""
    score, noise = nbv.CrossEntropy(by_height, num_points=64), nbv.SensorNoise(0.03, 0.02)
    planner = planner_of(nbv.FarthestView(12), score)
    together = nbv.episodes(planner, BALLS, POSES, 3, KEYS, noise)
    assert_equal(together, one_by_one(planner, BALLS, POSES, 3, KEYS, noise), planner.acquisition)
    assert len(np.unique(np.asarray(together.poses.position).reshape(-1, 3), axis=0)) >= 5
    assert together.answers.shape[:2] == (3, 3)
    assert (together.answers[:, 0] != together.answers[:, 1]).any()
    keys = jax.random.split(jax.random.key(8), 3)
    del compilations[:]
    more = nbv.episodes(planner, BALLS[::-1], FIRST, 4, keys, noise)
    # The pose along an axis, and slices of another length. None of these is the program of an episode.
    assert len(compilations) < 10
    assert_equal(more, one_by_one(planner, BALLS[::-1], 3 * [FIRST], 4, keys, noise), planner.acquisition)


def test_answer_values_are_those_of_the_answer():
    cloud = nbv.scan(nbv.SDFSurface(BALLS[0]), FARTHEST.camera, FIRST)
    scores = nbv.CrossEntropy(by_height), nbv.SoftPartCount(by_octant), lambda cloud: jnp.sum(cloud.points**2)
    for acquisition in (planner_of(score=score).acquisition for score in scores):
        values = acquisition.answer_values(cloud)
        assert values.size >= 1
        np.testing.assert_allclose(values, acquisition.answer(cloud).values, rtol=1e-5)


def test_scenes_on_a_grid_may_have_a_leading_axis():
    surfaces = [GridSurface.from_values(value, 0.0, nbv.Grid(20)) for value in VALUES]
    together = nbv.episodes(FARTHEST, BATCH, POSES, 3, KEYS)
    assert together.answers is None
    assert (together.clouds.count > 10).all()
    assert_same_bits(nbv.episodes(FARTHEST, surfaces, POSES, 3, KEYS), together)


@pytest.mark.slow
def test_answers_about_known_parts():
    blocks = [Cuboid([1.0, 0.4, 0.8]), Cuboid([0.5, 0.6, 0.6])]
    bank = nbv.ShapeBank.of(blocks, ["wide", "cube"], is_true_size=True)
    sampler = planner_of().sampler.with_bank(bank, FreeRotation())
    planner = planner_of(nbv.FarthestView(12))
    planner = eqx.tree_at(lambda planner: planner.sampler, planner, sampler)
    together = nbv.episodes(planner, blocks, POSES[:2], 3, KEYS[:2])
    assert together.answers.shape == (2, 3, 3)
    # Names are in alphabetical order.
    np.testing.assert_array_equal(np.argmax(together.answers[:, -1], axis=1), [1, 0])
    assert_equal(together, one_by_one(planner, blocks, POSES[:2], 3, KEYS[:2]), planner.acquisition)


def with_views(views):
    return lambda: nbv.episodes(COVERAGE, BALLS, FIRST, views, KEYS)


def of_scenes(*scenes):
    return lambda: nbv.episodes(COVERAGE, list(scenes), FIRST, 2, KEYS[: len(scenes)])


BOX = trimesh.creation.box()
WRONG = {
    "no view": (with_views(0), "asked for 0 views"),
    "more views than there is room for": (with_views(7), "room for 6: raise"),
    "triangles": (of_scenes(mesh_from_sdf(BALLS[0], nbv.Grid(20))), "scene 0 is a TriangleMesh.*solid_of_mesh"),
    "a mesh of trimesh's": (of_scenes(BALLS[0], BOX), "scene 1 is a Trimesh.*solid_of_mesh"),
    "one mesh": (lambda: nbv.episodes(COVERAGE, BOX, FIRST, 2, KEYS), "the scene is a Trimesh.*solid_of_mesh"),
    "two structures": (of_scenes(BALLS[0], Sphere(0.7)), r"scene 1 \(Sphere\) has another .* scene 0 \(Union\)"),
    "what is no scene": (of_scenes("spot.obj"), "scene 0 is 'spot.obj'; give Surface or SignedDistance"),
    "too few scenes": (lambda: nbv.episodes(COVERAGE, BALLS[:2], FIRST, 2, KEYS), "2 scenes for 3 keys"),
    "no leading axis": (lambda: nbv.episodes(COVERAGE, BALLS[0], FIRST, 2, KEYS), r"3 keys, but .* \[scene\] \* 3"),
    "too few poses": (lambda: nbv.episodes(COVERAGE, BALLS, POSES[:2], 2, KEYS), r"batch \(2,\) of poses for 3 keys"),
    "a pose in millimetres": (
        lambda: nbv.episodes(COVERAGE, BALLS, nbv.look_at((0.0, 0.0, 2500.0)), 2, KEYS),
        "not of the scene",
    ),
    "none at once": (lambda: nbv.episodes(COVERAGE, BALLS, FIRST, 2, KEYS, batch_size=0), "the batch size is 0"),
    "no keys": (lambda: nbv.episodes(COVERAGE, [], FIRST, 2, KEYS[:0]), "the keys are an array of shape"),
    "within jit": (
        lambda: jax.jit(lambda keys: nbv.episodes(COVERAGE, BALLS, FIRST, 2, keys).values)(KEYS),
        "outside jit",
    ),
}


@pytest.mark.parametrize(("call", "message"), WRONG.values(), ids=WRONG)
def test_what_cannot_be_meant_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_episodes_that_go_wrong_are_named():
    away = nbv.look_at((0.0, 0.0, 2.5), (0.0, 0.0, 9.0))
    firsts = jax.tree.map(lambda row, rows: rows.at[1].set(row), away, POSES)
    with pytest.raises(InputError, match="first view of episode 1 sees nothing"):
        nbv.episodes(FARTHEST, BATCH, firsts, 2, KEYS)
    with pytest.raises(InputError, match="value of view 5 of episode 0 is -inf: all candidates have been visited"):
        nbv.episodes(FARTHEST, BATCH, POSES, 5, KEYS)


PROGRAM = """
    import sys

    import jax

    jax.config.update("jax_num_cpu_devices", 2)
    import numpy as np

    import jaxnbv as nbv

    sampler = nbv.SurfaceSampler(nbv.GeometricSPSR(0.05, truncation=6), nbv.Grid(20), num_samples=2)
    camera, search = nbv.Camera(height=8, width=8), nbv.DiscreteSearch(8)
    planner = nbv.Planner(nbv.NewSurface(), search, camera, sampler, capacity=64, max_views=4)
    scenes = [nbv.sdf.Sphere(radius) for radius in (0.6, 0.7, 0.8)]
    first, keys, batch_size = nbv.look_at((0.8, 0.9, 2.2)), jax.random.split(jax.random.key(0), 3), int(sys.argv[1])
    shared = nbv.episodes(planner, scenes, first, 3, keys, batch_size=batch_size)
    assert len(shared.values.sharding.device_set) == 2
    if batch_size == 1:
        with jax.default_device(jax.devices()[0]):
            alone = nbv.episodes(planner, scenes, first, 3, keys)
        assert len(alone.values.sharding.device_set) == 1
        jax.tree.map(np.testing.assert_array_equal, shared, alone)
    else:
        runs = [nbv.simulate(planner, scene, first, 3, key, progress=False) for scene, key in zip(scenes, keys)]
        values = [[view.proposal.value for view in run.views[1:]] for run in runs]
        np.testing.assert_allclose(shared.values[:, 1:], np.asarray(values), rtol=1e-4)
        points = np.stack([run.cloud.points for run in runs])
        np.testing.assert_allclose(shared.clouds.points, points, rtol=0, atol=1e-5)
"""


@pytest.mark.parametrize("batch_size", [pytest.param("1", marks=pytest.mark.as_users), "2"])
def test_episodes_on_two_devices_are_those_on_one(batch_size, tmp_path):
    """In a process of its own, because JAX counts devices once. Two at once are those of `simulate` up to rounding."""
    program = tmp_path / "program.py"
    program.write_text(textwrap.dedent(PROGRAM))
    ended = subprocess.run([sys.executable, program, batch_size], capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, ended.stderr
