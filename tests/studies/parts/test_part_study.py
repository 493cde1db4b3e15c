"""The part study on a small scale, against independent scans, counts and scores."""

import functools
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxnbv.geometry.camera import Camera
from jaxnbv.networks import CATEGORIES, CloudSegmenter
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.search import DiscreteSearch, FarthestView, FreePoses, SpherePoses
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
RUN = ("discrete", "farthest")


class Pointwise(eqx.Module):
    """A segmenter of each point by itself. From `enough` points on, the parts alternate."""

    enough: jax.Array

    def __call__(self, points, normals, category, mask):
        weight = np.random.default_rng(1).normal(size=(6, 50))
        rows = jnp.concatenate([points, normals], axis=-1) @ jnp.asarray(weight, points.dtype)
        # The labels of a rocket's three parts differ modulo 3.
        turns = 9.0 * (jnp.arange(len(points))[:, None] % 3 == jnp.arange(50) % 3)
        return jax.nn.log_softmax(jnp.where(jnp.sum(mask) >= self.enough, turns, 8.0 * rows))


def small_study(enough=10**6, num_points=500, **settings):
    model = GeometricSPSR(lengthscale=0.05, truncation=8)
    small = {"views": VIEWS, "num_candidates": CANDIDATES, "num_samples": 2, "grid_resolution": 20}
    limits = {"capacity": 600, "imagined_rays": 12, "num_points": 100, "num_starts": 1, "iterations": 2}
    segmenter = CloudSegmenter(Pointwise(jnp.asarray(enough)), 0, num_points, scale=0.8)
    return PartStudy(segmenter=segmenter, camera=CAMERA, sampler=SurfaceSampler(model), **(small | limits | settings))


@functools.cache
def whole_record():
    return run_scene(small_study(), SCENE, RUN)


def replayed(study, method):
    return replay(study, study.scene(SCENE), whole_record()["methods"][method])


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
    study, scene = small_study(), part_scene(Split.TEST, SCENE)
    segmenter = CloudSegmenter(study.segmenter.network, scene.category, 500, scale=0.8)
    labels = np.flatnonzero(np.asarray(scene.parts))
    own = np.array(CATEGORIES[int(scene.category)].labels)
    weight = np.random.default_rng(1).normal(size=(6, 50))
    counts, steps = whole_record()["methods"]["discrete"]["counts"], replayed(study, "discrete")
    for row, (_, observations) in zip(counts, steps, strict=True):
        fed, said = segmenter.predict(observations.cloud)
        points, normals = np.asarray(fed.points, np.float64), np.asarray(fed.normals, np.float64)
        score = np.concatenate([0.8 * points, normals], axis=1) @ weight
        expected = np.where(np.asarray(fed.mask), own[np.argmax(score[:, own], axis=1)], -1)
        assert np.mean(expected == said) > 0.99
        np.testing.assert_allclose(row, [(expected == label).sum() for label in labels], atol=2)


def test_a_run_stops_once_every_part_has_the_largest_target():
    """The segmenter gives the parts equal shares once there are more points than in the first view."""
    first = int(replayed(small_study(), "farthest")[0][0].count)
    run = run_scene(small_study(first + 1, 2048, capacity=4096), SCENE, ("farthest",))["methods"]["farthest"]
    assert min(run["counts"][0]) < 100 <= min(run["counts"][-1])
    assert [min(counts) >= 100 for counts in run["counts"]] == [False] * (len(run["counts"]) - 1) + [True]
    assert len(run["counts"]) < VIEWS
    assert run["views"] == whole_record()["methods"]["farthest"]["views"][: len(run["views"])]


def test_planners_of_all_categories_share_their_compilations(compilations):
    study, values = small_study(), []
    observations = replayed(study, "discrete")[0][1]
    for index in (1, 4):
        planner = study.planner("discrete", study.scene(index))
        del compilations[:]
        values.append(np.asarray(planner.propose(observations, jax.random.key(1)).values))
    assert not compilations
    assert (values[0] != values[1]).any()


def test_pictures_are_of_the_scenes_and_methods_asked_for(tmp_path):
    record = whole_record() | {"methods": {"farthest": whole_record()["methods"]["farthest"]}}
    (path,) = write_pictures([record], small_study(), tmp_path / "a", scenes=2, pixels=24)
    assert path == tmp_path / "a" / f"scene_{SCENE:04d}.png"
    assert path.read_bytes()[:4] == b"\x89PNG"
