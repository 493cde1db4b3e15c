"""The part study on a small scale, against independent scans, counts and scores."""

import functools
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import concatenate, limit_capacity
from jaxnbv.geometry.pose import Pose
from jaxnbv.networks import CATEGORIES, CloudSegmenter
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import SDFSurface, SensorNoise, scan
from jaxnbv.search import (
    DiscreteSearch,
    FarthestView,
    FreePoses,
    SpherePoses,
)
from jaxnbv.studies.engine.pictures import write_pictures
from jaxnbv.studies.engine.run import replay, run_scene
from jaxnbv.studies.parts.study import PartStudy
from jaxnbv.studies.scenes import Split, part_scene
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage

# A rocket.
SCENE, CANDIDATES, VIEWS = 10, 12, 3
CAMERA = Camera(height=32, width=32)
# The other methods differ from these only in search or score.
RUN = ("discrete", "farthest", "random")


class Pointwise(eqx.Module):
    """A segmenter of each point by itself. From `enough` points on, the parts alternate."""

    enough: jax.Array

    def __call__(self, points, normals, category, mask):
        weight = np.random.default_rng(1).normal(size=(6, 50))
        rows = jnp.concatenate([points, normals], axis=-1) @ jnp.asarray(weight, points.dtype)
        # The labels of a rocket's three parts differ modulo 3.
        turns = 9.0 * (jnp.arange(len(points))[:, None] % 3 == jnp.arange(50) % 3)
        return jax.nn.log_softmax(jnp.where(jnp.sum(mask) >= self.enough, turns, 8.0 * rows))


def small_study(enough=10**6, **settings):
    model = GeometricSPSR(lengthscale=0.05, truncation=8)
    small = {"views": VIEWS, "num_candidates": CANDIDATES, "num_samples": 2, "grid_resolution": 20}
    limits = {"capacity": 600, "imagined_rays": 12, "num_points": 100, "num_starts": 1, "iterations": 2}
    segmenter = CloudSegmenter(Pointwise(jnp.asarray(enough)), 0, 500, scale=0.8)
    return PartStudy(segmenter=segmenter, camera=CAMERA, sampler=SurfaceSampler(model), **(small | limits | settings))


@functools.cache
def whole_record():
    return run_scene(small_study(), SCENE, RUN)


def pose_of(view):
    return Pose(np.asarray(view["rotation"], np.float32), np.asarray(view["position"], np.float32))


@eqx.filter_jit
def noisy_scan(solid, pose, key):
    return SensorNoise()(scan(SDFSurface(solid), CAMERA, pose), key)


def scans(record, method):
    """The sensor's scans, from the recorded poses and the study's key."""
    solid = part_scene(Split.TEST, record["scene"]).solid
    key = small_study().key(record["scene"], "episode")
    for index, view in enumerate(record["methods"][method]["views"]):
        _, noise_key = jax.random.split(jax.random.fold_in(key, index))
        yield noisy_scan(solid, pose_of(view), noise_key)


def clouds(record, method, capacity=600):
    cloud = None
    for one in scans(record, method):
        cloud = limit_capacity(one if cloud is None else concatenate(cloud, one), capacity)
        yield cloud


def test_a_record_is_json_and_holds_every_method():
    record, scene = json.loads(json.dumps(whole_record(), allow_nan=False)), part_scene(Split.TEST, SCENE)
    assert record == whole_record()
    assert list(record["methods"]) == list(RUN)
    assert (record["scene"], record["split"], record["study_views"]) == (SCENE, "test", VIEWS)
    category = CATEGORIES[int(scene.category)]
    assert record["category"] == category.name == "rocket"
    present = [bool(scene.parts[label]) for label in category.labels]
    assert record["parts"] == [name for name, there in zip(category.parts, present, strict=True) if there]
    for run in record["methods"].values():
        assert len(run["views"]) == len(run["counts"]) <= VIEWS
        assert {len(counts) for counts in run["counts"]} == {len(record["parts"])}
        positions = [tuple(np.round(view["position"], 3)) for view in run["views"]]
        assert len(set(positions)) == len(positions)


@pytest.mark.parametrize("method", RUN)
def test_every_choice_is_the_one_that_the_planner_proposes_with_the_same_key(method):
    record, study = whole_record(), small_study()
    planner = study.planner(method, study.scene(SCENE))
    views = [pose_of(view) for view in record["methods"][method]["views"]]
    observations = None
    for index, (pose, cloud) in enumerate(zip(views, scans(record, method), strict=True)):
        if observations is not None:
            key = jax.random.split(jax.random.fold_in(study.key(SCENE, "episode"), index))[0]
            np.testing.assert_allclose(planner.propose(observations, key).pose.position, pose.position, atol=1e-6)
        inputs = pose, cloud, study.camera
        observations = planner.init(*inputs) if observations is None else planner.observe(observations, *inputs)


def test_each_method_has_its_search_and_score():
    study = small_study()
    planners = {method: study.planner(method, study.scene(SCENE)) for method in study.methods}
    for method, search in {"discrete": DiscreteSearch, "farthest": FarthestView, "coverage": DiscreteSearch}.items():
        assert isinstance(planners[method].search, search)
    for method, space in {"gradient-2dof": SpherePoses, "gradient-6dof": FreePoses}.items():
        assert isinstance(planners[method].search.space, space)
    by_parts = {method for method, planner in planners.items() if not isinstance(planner.acquisition, Coverage)}
    assert by_parts == {"discrete", "gradient-2dof", "gradient-6dof"}


def test_counts_are_those_of_the_segmenter_on_all_that_was_seen():
    record, study, scene = whole_record(), small_study(), part_scene(Split.TEST, SCENE)
    segmenter = CloudSegmenter(study.segmenter.network, scene.category, 500, scale=0.8)
    run = record["methods"]["discrete"]
    again = replay(study, study.scene(SCENE), run)
    assert len(again) == len(run["counts"])
    labels = np.flatnonzero(np.asarray(scene.parts))
    for counts, cloud, (_, observations) in zip(run["counts"], clouds(record, "discrete"), again, strict=True):
        np.testing.assert_allclose(observations.cloud.points, cloud.points, atol=1e-5)
        fed, said = segmenter.predict(cloud)
        points, normals = np.asarray(fed.points, np.float64), np.asarray(fed.normals, np.float64)
        weight = np.random.default_rng(1).normal(size=(6, 50))
        score = np.concatenate([0.8 * points, normals], axis=1) @ weight
        own = np.array(CATEGORIES[int(scene.category)].labels)
        expected = np.where(np.asarray(fed.mask), own[np.argmax(score[:, own], axis=1)], -1)
        assert np.mean(expected == said) > 0.99
        np.testing.assert_allclose(counts, [(expected == label).sum() for label in labels], atol=2)


def test_a_run_stops_once_every_part_has_the_largest_target():
    """The segmenter gives the parts equal shares once there are more points than in the first view."""
    first = int(next(scans(whole_record(), "farthest")).count)
    study = small_study(first + 1, capacity=4096)
    study = eqx.tree_at(lambda s: s.segmenter, study, CloudSegmenter(study.segmenter.network, 0, 2048, scale=0.8))
    record = run_scene(study, SCENE, ("farthest",))
    run = record["methods"]["farthest"]
    assert min(run["counts"][0]) < 100 <= min(run["counts"][-1])
    assert [min(counts) >= 100 for counts in run["counts"]] == [False] * (len(run["counts"]) - 1) + [True]
    assert len(run["counts"]) < VIEWS
    assert run["views"] == whole_record()["methods"]["farthest"]["views"][: len(run["views"])]


def test_planners_of_all_categories_share_their_compilations(compilations):
    study, first = small_study(), pose_of(whole_record()["methods"]["discrete"]["views"][0])
    observations = study.planner("discrete", study.scene(0)).init(
        first, next(scans(whole_record(), "discrete")), CAMERA
    )
    values = []
    for index in (1, 4):
        planner = study.planner("discrete", study.scene(index))
        del compilations[:]
        values.append(np.asarray(planner.propose(observations, jax.random.key(1)).values))
    assert not compilations
    assert (values[0] != values[1]).any()


def test_pictures_are_of_the_scenes_and_methods_asked_for(tmp_path):
    (path,) = write_pictures([whole_record()], small_study(), tmp_path / "a", scenes=2, pixels=24)
    assert path == tmp_path / "a" / f"scene_{SCENE:04d}.png"
    assert path.read_bytes()[:4] == b"\x89PNG"
