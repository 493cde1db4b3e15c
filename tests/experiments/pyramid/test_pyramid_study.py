"""The pyramid study on a small scale, against the library's own scores and searches."""

import functools
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv.acquisition import ExpectedUtilityImprovement
from jaxnbv.camera import Camera
from jaxnbv.checks import InputError
from jaxnbv.cloud import concatenate, limit_capacity
from jaxnbv.datasets import Framing, Pyramid, Split, pyramid_scene
from jaxnbv.experiments.pyramid import study as pyramid_study
from jaxnbv.experiments.pyramid.study import METHODS, PyramidStudy, run_scene
from jaxnbv.experiments.records import RecordFolder
from jaxnbv.scanning import Carving, SDFSurface, scan
from jaxnbv.search import FarthestView, Problem, UncertaintyView
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage
from jaxnbv.tasks.classification import CrossEntropy, MixedEntropy, NegativeEntropy

SCENE, CANDIDATES = 3, 14


class Linear(eqx.Module):
    """An opinion on five classes from the means of points and normals; `sharpness` makes it firm."""

    sharpness: jax.Array = eqx.field(converter=jnp.asarray, default=2.0)

    def __call__(self, cloud):
        rows = jnp.concatenate([cloud.points, cloud.normals], axis=-1)
        mean = jnp.sum(jnp.where(cloud.mask[:, None], rows, 0.0), axis=0) / jnp.maximum(cloud.count, 1)
        weight = jnp.asarray(np.random.default_rng(1).normal(size=(5, 6)), mean.dtype)
        return jax.nn.log_softmax(self.sharpness * weight @ mean)


class Knowing(eqx.Module):
    """Knows the class once some points lie on the floor of the scene's pattern, and nothing before."""

    pyramid: Pyramid

    def __call__(self, cloud):
        u, v, w = self.pyramid._own(cloud.points)
        floor = cloud.mask & (jnp.abs(w - self.pyramid.depth) < 0.025) & (self.pyramid._imprint(u, v, 0.0 * w) < -0.03)
        certainty = 5.0 * jnp.minimum(jnp.sum(floor) / 40.0, 1.0)
        return jax.nn.log_softmax(certainty * jax.nn.one_hot(self.pyramid.label, 5))


def small_study(classifier=None, views=3, **settings):
    model = GeometricSPSR(lengthscale=0.05, truncation=8)
    small = {"num_candidates": CANDIDATES, "num_samples": 2, "grid_resolution": 20}
    limits = {"capacity": 250, "num_points": 100}
    surfaces = model, Carving()
    return PyramidStudy(classifier or Linear(), Framing.CLOSE_UP, *surfaces, views=views, **(small | limits | settings))


@functools.cache
def whole_record():
    return run_scene(small_study(), SCENE)


@pytest.fixture
def scene():
    return pyramid_study._Scene(small_study(), SCENE)


def without_time(record):
    return {key: value for key, value in record.items() if key != "seconds"}


def test_a_record_is_json_and_holds_every_method():
    record = json.loads(json.dumps(whole_record(), allow_nan=False))
    assert record == whole_record()
    assert list(record["methods"]) == list(METHODS)
    pyramid = pyramid_scene(Split.TEST, SCENE)
    assert record["scene"] == SCENE
    assert record["framing"] == "close-up"
    assert record["label"] == int(pyramid.label)
    assert 0 <= record["random_hit"] <= 1
    for name, method in record["methods"].items():
        assert len(method["runs"]) == (8 if name == "random" else 1)
        for run in method["runs"]:
            assert len(run["candidates"]) == len(set(run["candidates"])) == 3
            assert set(run["candidates"]) <= set(range(CANDIDATES))
            assert run["pattern_pixels"] == [record["pattern_pixels"][i] for i in run["candidates"]]
            np.testing.assert_allclose(np.exp(run["log_p"]).sum(axis=1), 1.0, atol=1e-5)
            assert np.shape(run["log_p"]) == (3, 5)
    assert len({tuple(run["candidates"]) for run in record["methods"]["random"]["runs"]}) > 1


def test_a_scene_can_be_run_again():
    assert without_time(run_scene(small_study(), SCENE)) == without_time(whole_record())


def test_the_first_view_is_that_of_all_methods_and_shows_no_pattern_but_something():
    record = whole_record()
    firsts = {run["candidates"][0] for method in record["methods"].values() for run in method["runs"]}
    assert firsts == {record["first"]}
    pyramid, poses = pyramid_scene(Split.TEST, SCENE), sphere_candidates(CANDIDATES, 2.5)
    seen = scan(SDFSurface(pyramid), Camera(), poses)
    pixels = np.asarray(jnp.sum(pyramid.on_pattern(seen.points) & seen.mask, axis=-1))
    assert pixels[record["first"]] == 0 < int(seen.count[record["first"]])
    np.testing.assert_allclose(record["pattern_pixels"], pixels, atol=2)
    assert pixels.max() > 500
    outward = -np.asarray(pyramid.rotation)[:, 2]
    angle = np.degrees(np.arccos(np.asarray(poses.position[record["first"]]) @ outward / 2.5))
    assert record["angle"] == pytest.approx(angle, abs=0.05)


def test_some_methods_alone_choose_as_among_all():
    for some in (("farthest", "random"), ("mixed", "oracle")):
        record = run_scene(small_study(), SCENE, some)
        assert list(record["methods"]) == list(some)
        for name in some:
            assert record["methods"][name] == whole_record()["methods"][name]
    found = run_scene(small_study(), SCENE, ("farthest", "oracle"))["diagnostics"]
    assert {name for entry in found for name in entry["methods"]} == {"farthest", "oracle"}
    assert all(entry["roughness"] is None and entry["near_sensor"] is None for entry in found)


def test_diagnostics_of_every_method_at_every_view():
    found = whole_record()["diagnostics"]
    for view in (2, 3):
        names = [name for entry in found if entry["view"] == view for name in entry["methods"]]
        assert sorted(names) == sorted(set(METHODS) - {"random"})
    for entry in found:
        assert list(entry["rank_correlation"]) == entry["methods"]
        draws_samples = not {*entry["methods"]} & {"farthest", "oracle"}
        assert (entry["roughness"] is not None) == (entry["near_sensor"] is not None) == draws_samples
        if draws_samples:
            assert entry["roughness"] > 0
            assert 0 <= entry["near_sensor"] <= 1
        for correlation in entry["rank_correlation"].values():
            assert correlation is None or -1 <= correlation <= 1


@eqx.filter_jit
def scores_by_hand(scores, cloud, surfaces, camera, poses):
    """The mean over samples of each score of each scan: `expected_score`, with scans that all scores share."""
    contexts = [score.context(cloud) for score in scores]

    def of_scan(one):
        return jnp.stack([score(context, one) for score, context in zip(scores, contexts, strict=True)])

    def of_sample(surface):
        return jax.lax.map(of_scan, scan(surface, camera, poses))

    return jnp.mean(jax.lax.map(of_sample, surfaces), axis=0).T


@pytest.mark.parametrize("sharpness", [0.3, 12.0])
def test_values_are_the_librarys_scores_of_the_same_samples(sharpness):
    """Undecided, above the threshold of the mixed score, and nearly decided, below it."""
    classifier = Linear(sharpness)
    study = small_study(classifier)
    scene = pyramid_study._Scene(study, SCENE)
    visited = (scene.first, (scene.first + 5) % CANDIDATES)
    found = scene._acquisitions(visited, [name for name in METHODS if name != "random"], 3)
    state, planner = scene._state(visited), study.planner
    assert int(state.num_views) == 2
    surfaces = planner.sample_surfaces(state, jax.random.fold_in(jax.random.fold_in(scene.key, 2), 3))
    scores = {
        "cross-entropy": CrossEntropy(classifier, num_points=100),
        "mixed": MixedEntropy(classifier, num_points=100),
        "entropy": ExpectedUtilityImprovement(NegativeEntropy(classifier), num_points=100),
        "coverage": Coverage(),
    }
    expected = scores_by_hand(tuple(scores.values()), state.cloud, surfaces, planner.camera, scene.poses)
    for name, value in zip(scores, expected, strict=True):
        np.testing.assert_allclose(found[name], value, rtol=1e-4, atol=1e-5, err_msg=name)
    is_open = float(-NegativeEntropy(classifier)(limit_capacity(state.cloud, 100))) > 0.75
    assert is_open == (sharpness < 1)
    np.testing.assert_array_equal(found["mixed"], found["cross-entropy" if is_open else "entropy"])
    problem = Problem(state.cloud, state.poses, state.num_views, planner.camera, Coverage(), surfaces)
    for name, search in (("farthest", FarthestView(CANDIDATES)), ("uncertainty", UncertaintyView(CANDIDATES))):
        expected = np.asarray(search.propose(problem, jax.random.key(0)).values)
        new = np.setdiff1d(np.arange(CANDIDATES), visited)
        np.testing.assert_allclose(found[name][new], expected[new], rtol=1e-4, atol=1e-5)
        assert np.isneginf(expected[list(visited)]).all()
    thinned = limit_capacity(state.cloud, 100)
    p = np.exp(np.asarray(classifier(thinned), np.float64))
    for candidate in (0, 7):
        q = np.asarray(classifier(concatenate(thinned, scene.truth.scans[candidate])), np.float64)
        assert found["oracle"][candidate] == pytest.approx(-np.sum(p * q), rel=1e-4)


def test_the_choice_is_the_best_candidate_not_visited(scene):
    values = np.array([5.0, 9.0, 7.0, 9.0])
    np.testing.assert_array_equal(pyramid_study._without(values, (1,)), [5.0, -np.inf, 7.0, 9.0])
    np.testing.assert_array_equal(values, [5.0, 9.0, 7.0, 9.0])
    first = scene.first
    value = np.delete(scene._acquisitions((first,), ["farthest"], 2)["farthest"], first)
    assert (
        whole_record()["methods"]["farthest"]["runs"][0]["candidates"][1]
        == np.delete(np.arange(CANDIDATES), first)[value.argmax()]
    )


def test_answers_are_the_classifiers_of_all_that_was_seen(scene):
    run = whole_record()["methods"]["coverage"]["runs"][0]
    planner, study = scene.study.planner, scene.study
    state = planner.init(scene.truth.scans[run["candidates"][0]], scene.poses[run["candidates"][0]])
    for count, index in enumerate(run["candidates"]):
        if count:
            state = planner.observe(state, scene.poses[index], scene.truth.scans[index])
        expected = study.classifier(state.cloud)
        np.testing.assert_allclose(run["log_p"][count], expected, atol=1e-5)


def test_with_a_classifier_that_knows_the_pattern_the_oracle_looks_at_it():
    """And the share of single views that a random second view would be right with is the share that shows enough."""
    study = small_study(Knowing(pyramid_scene(Split.TEST, SCENE)))
    record = run_scene(study, SCENE, ("oracle",))
    run, pixels = record["methods"]["oracle"]["runs"][0], np.array(record["pattern_pixels"])
    assert run["pattern_pixels"][1] >= 0.25 * pixels.max() > 200
    assert np.ptp(run["log_p"][0]) == pytest.approx(0.0, abs=1e-5)
    assert int(np.argmax(run["log_p"][1])) == record["label"]
    assert np.ptp(run["log_p"][1]) > 1.0
    shown = np.delete(pixels, record["first"])
    # Scene 3 is of class 3: a tie of all classes is no right answer.
    assert np.mean(shown > 1000) <= record["random_hit"] <= np.mean(shown > 0) < 1


def test_too_few_views_or_candidates_are_refused():
    for settings in ({"views": 1}, {"views": 15}):
        with pytest.raises(InputError, match="at least two views"):
            small_study(**settings)


def test_records_are_kept_and_the_missing_ones_made(tmp_path):
    asked = []

    def run(index):
        asked.append(index)
        if index == 2 and len(asked) == 3:
            raise KeyboardInterrupt
        return {"scene": index, "value": 0.1 * index}

    config = {"views": 3, "radii": (1, 2)}
    with pytest.raises(KeyboardInterrupt):
        RecordFolder(tmp_path / "a" / "b", config).collect(4, run, progress=False)
    found = RecordFolder(tmp_path / "a" / "b", config).collect(4, run, progress=False)
    assert asked == [0, 1, 2, 2, 3]
    assert found == [{"scene": index, "value": 0.1 * index} for index in range(4)]
    assert RecordFolder(tmp_path / "a" / "b", config).collect(2, run, progress=False) == found[:2]
    assert len(asked) == 5
    (tmp_path / "a" / "b" / "scene_0001.json").unlink()
    assert RecordFolder(tmp_path / "a" / "b", config).collect(4, run, progress=False) == found
    assert asked[5:] == [1]


def test_folders_of_another_study_and_damaged_records_are_refused(tmp_path):
    RecordFolder(tmp_path, {"views": 3, "framing": "whole"}).collect(1, lambda index: {"scene": index}, progress=False)
    with pytest.raises(InputError, match="another study; it differs in views: 3 there, 4 now"):
        RecordFolder(tmp_path, {"views": 4, "framing": "whole"})
    for damaged in (b'{"scene": ', b"", b"\xff\xfe\x00"):
        (tmp_path / "scene_0000.json").write_bytes(damaged)
        with pytest.raises(InputError, match=r"scene_0000\.json is damaged"):
            RecordFolder(tmp_path, {"views": 3, "framing": "whole"}).collect(1, lambda index: {}, progress=False)
    (tmp_path / "study.json").write_bytes(b"[")
    with pytest.raises(InputError, match=r"study\.json is damaged"):
        RecordFolder(tmp_path, {"views": 3, "framing": "whole"})
    (tmp_path / "file").write_text("here")
    with pytest.raises(InputError, match="cannot make the output folder"):
        RecordFolder(tmp_path / "file", {"views": 3})
