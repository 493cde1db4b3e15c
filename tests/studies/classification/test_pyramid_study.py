"""The pyramid study on a small scale, against the library's own acquisitions and planners."""

import functools
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import concatenate, limit_capacity
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.search import FarthestView, SphereCandidates
from jaxnbv.studies.classification.objects import PyramidStudy
from jaxnbv.studies.engine.pictures import write_pictures
from jaxnbv.studies.engine.run import run_scene
from jaxnbv.studies.scenes import Split, pyramid_scene
from jaxnbv.studies.scenes.class_object import scan_cue
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage

SCENE, CANDIDATES = 3, 14
CAMERA = Camera(height=24, width=24)


class Linear(eqx.Module):
    """A classifier of the means of points and normals."""

    count: int = eqx.field(static=True, default=5)

    def __call__(self, cloud):
        rows = jnp.concatenate([cloud.points, cloud.normals], axis=-1)
        mean = jnp.sum(jnp.where(cloud.mask[:, None], rows, 0.0), axis=0) / jnp.maximum(cloud.count, 1)
        weight = jnp.asarray(np.random.default_rng(1).normal(size=(self.count, 6)), mean.dtype)
        return jax.nn.log_softmax(2.0 * weight @ mean)


def small_study(classifier=None, kind=PyramidStudy, **settings):
    small = {"num_candidates": CANDIDATES, "num_samples": 2, "grid_resolution": 20, "capacity": 250, "num_points": 100}
    fixed = {"classifier": classifier or Linear(len(kind.objects.classes)), "views": 3, "camera": CAMERA}
    model = GeometricSPSR(lengthscale=0.05, truncation=8)
    return kind(**({"sampler": SurfaceSampler(model)} | fixed | small | settings))


@functools.cache
def whole_record():
    return run_scene(small_study(), SCENE)


def observations_of(study, planner, scene, candidates):
    """Observations of a planner after the true scans from some candidates."""
    poses, scans = study.candidates.poses(), scene.task.scans
    *_, observations = planner.replay((poses[index], scans[index]) for index in candidates)
    return observations


def step_key(study, view, run=None):
    """The key of a step of an episode, for its samples and its search."""
    key = study.key(SCENE, "episode")
    key = key if run is None else jax.random.fold_in(key, run)
    return jax.random.split(jax.random.fold_in(key, view))[0]


def without_time(record):
    """The record without seconds, at any depth."""
    if isinstance(record, list):
        return [without_time(one) for one in record]
    if isinstance(record, dict):
        return {key: without_time(value) for key, value in record.items() if key != "seconds"}
    return record


def test_a_record_is_json_and_holds_every_method():
    record = json.loads(json.dumps(whole_record(), allow_nan=False))
    assert record == whole_record()
    assert list(record["methods"]) == list(PyramidStudy.methods)
    pyramid = pyramid_scene(Split.TEST, SCENE)
    assert record["scene"] == SCENE
    assert record["framing"] == "close-up"
    assert record["label"] == int(pyramid.label)
    places = [tuple(place) for place in np.asarray(SphereCandidates(CANDIDATES).poses().position).tolist()]
    for name, method in record["methods"].items():
        positions = [tuple(view["position"]) for view in method["views"]]
        assert len({*positions}) == 3
        assert {*positions} <= {*places}
        assert np.shape(method["log_p"]) == (8 if name == "random" else 1, 3, 5)
        assert np.shape(method["pixels"]) == np.shape(method["log_p"])[:2]
        np.testing.assert_allclose(np.exp(method["log_p"]).sum(axis=-1), 1.0, atol=1e-5)
    assert len({tuple(run) for run in record["methods"]["random"]["pixels"]}) > 1


def chosen(study, method):
    """Candidates of a method's first run."""
    places = np.asarray(study.candidates.poses().position)
    return [int(np.linalg.norm(places - view["position"], axis=1).argmin()) for view in method["views"]]


def test_the_first_view_is_that_of_all_methods_and_shows_no_pattern_but_something():
    record = whole_record()
    assert {chosen(small_study(), method)[0] for method in record["methods"].values()} == {record["first"]}
    pyramid, poses = pyramid_scene(Split.TEST, SCENE), SphereCandidates(CANDIDATES).poses()
    _, num_pixels = scan_cue(pyramid, CAMERA, poses)
    pixels = np.asarray(jnp.sum(pyramid.on_cue(num_pixels.points) & num_pixels.mask, axis=-1))
    assert pixels[record["first"]] == 0 < int(num_pixels.count[record["first"]])
    for method in record["methods"].values():
        np.testing.assert_allclose(method["pixels"][0], pixels[chosen(small_study(), method)], atol=1)
    outward = -np.asarray(pyramid.solid.rotation)[:, 2]
    angle = np.degrees(np.arccos(np.asarray(poses.position[record["first"]]) @ outward / 2.5))
    assert record["angle"] == pytest.approx(angle, abs=0.05)


def test_diagnostics_of_every_method_are_by_the_view_that_was_chosen():
    for name, method in whole_record()["methods"].items():
        ranks, rough = method["rank_correlation"], method["roughness"]
        assert len(ranks) == len(rough) == 3
        assert ranks[0] is rough[0] is None
        assert [value is not None for value in rough[1:]] == [name not in ("farthest", "random", "oracle")] * 2
        assert all(value is None or -1 <= value <= 1 for value in ranks)
        assert all(value is None or value > 0 for value in rough)


def test_every_choice_is_the_one_that_the_planner_proposes_with_the_same_key():
    """Each method's planner by `propose` alone, at each view of its run. For random search, the first run."""
    study, record = small_study(), whole_record()
    scene, places = study.scene(SCENE), np.asarray(study.candidates.poses().position)
    for method, run in record["methods"].items():
        planner, indices = study.planner(method, scene), chosen(study, run)
        for view in (1, 2):
            observations = observations_of(study, planner, scene, indices[:view])
            proposed = planner.propose(
                observations, step_key(study, view, 0 if method == "random" else None)
            ).pose.position
            np.testing.assert_allclose(places[indices[view]], proposed, atol=1e-6, err_msg=method)


def test_the_oracle_values_true_scans():
    study = small_study()
    scene, visited = study.scene(SCENE), [2, 7]
    planner = study.planner("oracle", scene)
    observations = observations_of(study, planner, scene, visited)
    values = planner.propose(observations, jax.random.key(3)).values
    thinned = limit_capacity(observations.cloud, 100)
    p = np.exp(np.asarray(study.classifier(thinned), np.float64))
    for candidate in (0, 5):
        q = np.asarray(study.classifier(concatenate(thinned, scene.task.scans[candidate])), np.float64)
        assert values[candidate] == pytest.approx(-np.sum(p * q), rel=1e-4)


def test_answers_are_the_classifiers_of_all_that_was_seen():
    study, method = small_study(), whole_record()["methods"]["coverage"]
    scene, indices = study.scene(SCENE), chosen(small_study(), whole_record()["methods"]["coverage"])
    planner = study.planner("coverage", scene)
    for count in (1, 2, 3):
        observations = observations_of(study, planner, scene, indices[:count])
        np.testing.assert_allclose(method["log_p"][0][count - 1], study.classifier(observations.cloud), atol=1e-5)


def test_a_method_of_ones_own_sees_what_others_see_from_a_candidate(tmp_path):
    study = small_study()

    def own(study, scene):
        return study.planner_of(Coverage(), FarthestView(study.candidates), scene)

    record = run_scene(study, SCENE, ("random",), {"mine:own": own})
    ours, farthest = record["methods"]["mine:own"], whole_record()["methods"]["farthest"]
    np.testing.assert_allclose(ours["log_p"], farthest["log_p"], atol=1e-5)
    assert ours["pixels"] == farthest["pixels"]
    for one in (record, whole_record()):
        (path,) = write_pictures([one], study, tmp_path, pixels=24)
        assert path == tmp_path / f"scene_{SCENE:04d}.png"
        with Image.open(path) as image:
            assert np.asarray(image.convert("L")).std() > 5
