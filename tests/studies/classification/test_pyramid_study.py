"""The pyramid study on a small scale, against the library's own acquisitions and planners."""

import functools
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxnbv.studies.classification.shared import propose_together
from PIL import Image

from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import concatenate, limit_capacity
from jaxnbv.imagination import Imagination
from jaxnbv.scanning import scan
from jaxnbv.search import FarthestView, SphereCandidates
from jaxnbv.studies.classification.objects import PyramidStudy
from jaxnbv.studies.classification.pictures import write_pictures
from jaxnbv.studies.scenes import Framing, Pyramid, Split, pyramid_scene
from jaxnbv.studies.scenes.class_object import scan_cue
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage
from jaxnbv.tasks.classification import CrossEntropy, EntropyReduction, MixedEntropy, entropy

SCENE, CANDIDATES = 3, 14
CAMERA = Camera(height=24, width=24)
RAYS = CAMERA.height * CAMERA.width


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
    fixed = {"classifier": classifier or Linear(), "framing": Framing.CLOSE_UP, "views": views}
    return PyramidStudy(camera=CAMERA, imagination=Imagination(model), **(fixed | small | limits | settings))


@functools.cache
def whole_record():
    return small_study().run_scene(SCENE)


def evidence_of(study, planner, scene, candidates):
    """What a planner knows after the true scans from some candidates."""
    poses, scans = study.candidates.poses(), scene.task.scans
    *_, evidence = planner.replay((poses[index], scans[index]) for index in candidates)
    return evidence


def step_key(study, view, run=None):
    """The key of a step of an episode: of its samples and its search."""
    key = study.key(SCENE, "episode")
    key = key if run is None else jax.random.fold_in(key, run)
    return jax.random.split(jax.random.fold_in(key, view))[0]


def without_time(record):
    return {key: value for key, value in record.items() if key != "seconds"}


def test_a_record_is_json_and_holds_every_method():
    record = json.loads(json.dumps(whole_record(), allow_nan=False))
    assert record == whole_record()
    assert list(record["methods"]) == list(PyramidStudy.methods)
    pyramid = pyramid_scene(Split.TEST, SCENE)
    assert record["scene"] == SCENE
    assert record["framing"] == "close-up"
    assert record["label"] == int(pyramid.label)
    assert 0 <= record["methods"]["random"]["hit"] <= 1
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
    assert without_time(small_study().run_scene(SCENE)) == without_time(whole_record())


def test_the_first_view_is_that_of_all_methods_and_shows_no_pattern_but_something():
    record = whole_record()
    firsts = {run["candidates"][0] for method in record["methods"].values() for run in method["runs"]}
    assert firsts == {record["first"]}
    pyramid, poses = pyramid_scene(Split.TEST, SCENE), SphereCandidates(CANDIDATES).poses()
    _, seen = scan_cue(pyramid, CAMERA, poses)
    pixels = np.asarray(jnp.sum(pyramid.on_cue(seen.points) & seen.mask, axis=-1))
    assert pixels[record["first"]] == 0 < int(seen.count[record["first"]])
    np.testing.assert_allclose(record["pattern_pixels"], pixels, atol=1)
    assert pixels.max() > 0.2 * RAYS
    outward = -np.asarray(pyramid.rotation)[:, 2]
    angle = np.degrees(np.arccos(np.asarray(poses.position[record["first"]]) @ outward / 2.5))
    assert record["angle"] == pytest.approx(angle, abs=0.05)


def test_some_methods_alone_choose_as_among_all():
    for some in (("farthest", "random"), ("mixed", "oracle")):
        record = small_study().run_scene(SCENE, some)
        assert list(record["methods"]) == list(some)
        for name in some:
            assert record["methods"][name] == whole_record()["methods"][name]


def test_diagnostics_of_every_method_at_every_view():
    for name, method in whole_record()["methods"].items():
        found = method["diagnostics"]
        assert [entry["view"] for entry in found] == ([] if name == "random" else [2, 3])
        for entry in found:
            draws_samples = name not in ("farthest", "oracle")
            assert (entry["roughness"] is not None) == draws_samples
            assert entry["roughness"] is None or entry["roughness"] > 0
            assert entry["rank_correlation"] is None or -1 <= entry["rank_correlation"] <= 1


@pytest.mark.slow
def test_every_choice_is_the_one_that_the_planner_proposes_with_the_same_key():
    """Each method's planner alone, by `propose`, at each view of its run; and each run of random search."""
    study, record = small_study(), whole_record()
    scene, places = study.scene(SCENE), np.asarray(study.candidates.poses().position)
    for method, held in record["methods"].items():
        planner = study.planner(method, scene)
        for run, found in enumerate(held["runs"]):
            for view in (1, 2):
                evidence = evidence_of(study, planner, scene, found["candidates"][:view])
                key = step_key(study, view, run if method == "random" else None)
                proposed = planner.propose(evidence, key).pose.position
                np.testing.assert_allclose(places[found["candidates"][view]], proposed, atol=1e-6, err_msg=method)


@eqx.filter_jit
def values_by_hand(acquisitions, cloud, surfaces, camera, poses):
    """The mean over samples of each acquisition of each scan, one after the other."""
    contexts = [acquisition.context(cloud) for acquisition in acquisitions]

    def of_scan(one):
        return jnp.stack([each(context, one) for each, context in zip(acquisitions, contexts, strict=True)])

    def of_sample(surface):
        return jax.lax.map(of_scan, scan(surface, camera, poses))

    return jnp.mean(jax.lax.map(of_sample, surfaces), axis=0).T


@pytest.mark.parametrize("sharpness", [0.3, 12.0])
def test_values_of_methods_that_share_scans_are_each_their_own(sharpness):
    """Undecided, above the threshold of the mixed acquisition, and nearly decided, below it."""
    classifier = Linear(sharpness)
    study = small_study(classifier)
    scene, visited, key = study.scene(SCENE), [2, 7], jax.random.key(3)
    planners = {name: study.planner(name, scene) for name in study.methods if name != "random"}
    planner = planners["coverage"]
    evidence = evidence_of(study, planner, scene, visited)
    assert int(evidence.num_views) == 2
    surfaces = planner.imagination.sample(evidence, key)
    found = propose_together(planners, evidence, surfaces, key)
    acquisitions = {
        "cross-entropy": CrossEntropy(classifier, num_points=100),
        "mixed": MixedEntropy(classifier, num_points=100),
        "entropy": EntropyReduction(classifier, num_points=100),
        "coverage": Coverage(),
    }
    poses, new = study.candidates.poses(), np.setdiff1d(np.arange(CANDIDATES), visited)
    expected = values_by_hand(tuple(acquisitions.values()), evidence.cloud, surfaces, planner.camera, poses)
    for name, value in zip(acquisitions, np.asarray(expected), strict=True):
        np.testing.assert_allclose(found[name].values[new], value[new], rtol=1e-4, atol=1e-5, err_msg=name)
        assert np.isneginf(found[name].values[np.array(visited)]).all()
    is_open = float(entropy(classifier(limit_capacity(evidence.cloud, 100)))) > 0.75
    assert is_open == (sharpness < 1)
    same = found["cross-entropy" if is_open else "entropy"]
    np.testing.assert_array_equal(found["mixed"].values, same.values)
    np.testing.assert_array_equal(found["tie-break"].values, found["cross-entropy"].values)
    thinned = limit_capacity(evidence.cloud, 100)
    p = np.exp(np.asarray(classifier(thinned), np.float64))
    for candidate in new[[0, 5]]:
        q = np.asarray(classifier(concatenate(thinned, scene.task.scans[candidate])), np.float64)
        assert found["oracle"].values[candidate] == pytest.approx(-np.sum(p * q), rel=1e-4)


def test_answers_are_the_classifiers_of_all_that_was_seen():
    study, run = small_study(), whole_record()["methods"]["coverage"]["runs"][0]
    scene = study.scene(SCENE)
    planner = study.planner("coverage", scene)
    for count in (1, 2, 3):
        evidence = evidence_of(study, planner, scene, run["candidates"][:count])
        np.testing.assert_allclose(run["log_p"][count - 1], study.classifier(evidence.cloud), atol=1e-5)


def test_a_method_of_ones_own_sees_what_others_see_from_a_candidate(tmp_path):
    study = small_study()
    farthest = study.run_scene(SCENE, ("farthest",))["methods"]["farthest"]["runs"][0]

    def own(study, scene):
        return study.planner_of(Coverage(), FarthestView(study.candidates), scene)

    record = study.run_scene(SCENE, ("random",), {"mine:own": own})
    (run,) = record["methods"]["mine:own"]["runs"]
    np.testing.assert_allclose(run["log_p"], farthest["log_p"], atol=1e-5)
    assert np.abs(np.subtract(run["pattern_pixels"], farthest["pattern_pixels"])).max() <= 1
    for shown in (record, whole_record()):
        (path,) = write_pictures([shown], study, tmp_path, pixels=24)
        assert path == tmp_path / f"views_{SCENE:03d}.png"
        with Image.open(path) as image:
            assert np.asarray(image.convert("L")).std() > 5


def test_with_a_classifier_that_knows_the_pattern_the_oracle_looks_at_it():
    """And the share of single views that a random second view would be right with is the share that shows enough."""
    study = small_study(Knowing(pyramid_scene(Split.TEST, SCENE)))
    record = study.run_scene(SCENE, ("oracle", "random"))
    run, pixels = record["methods"]["oracle"]["runs"][0], np.array(record["pattern_pixels"])
    assert run["pattern_pixels"][1] >= 0.25 * pixels.max() > 0.08 * RAYS
    assert np.ptp(run["log_p"][0]) == pytest.approx(0.0, abs=1e-5)
    assert int(np.argmax(run["log_p"][1])) == record["label"]
    assert np.ptp(run["log_p"][1]) > 1.0
    shown = np.delete(pixels, record["first"])
    # Scene 3 is of class 3: a tie of all classes is no right answer.
    assert np.mean(shown > 0.4 * RAYS) <= record["methods"]["random"]["hit"] <= np.mean(shown > 0) < 1


def test_too_few_views_or_candidates_are_refused():
    for settings in ({"views": 1}, {"views": 15}):
        with pytest.raises(InputError, match="at least two views"):
            small_study(**settings)
