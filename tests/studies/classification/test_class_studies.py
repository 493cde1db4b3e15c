"""The studies of classes on a small scale, against the library's own classifiers, scans and acquisitions."""

import dataclasses
import functools
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from PIL import Image

from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import concatenate, limit_capacity
from jaxnbv.geometry.pose import look_at
from jaxnbv.networks import InvariantClassifier, save_checkpoint
from jaxnbv.readers import class_meshes
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.search import GradientSearch, TieBreakSearch
from jaxnbv.studies.classification.objects import HouseholdStudy, OmniObject3DStudy, PyramidStudy, TruckStudy
from jaxnbv.studies.classification.study import OracleView
from jaxnbv.studies.engine.chart import chart
from jaxnbv.studies.engine.pictures import write_pictures
from jaxnbv.studies.engine.results import results, summary
from jaxnbv.studies.engine.run import replay, run_scene
from jaxnbv.studies.engine.study import Study
from jaxnbv.studies.scenes import HOUSEHOLD, FirstView, Split, pyramid_scene
from jaxnbv.studies.scenes.class_object import scan_cue
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage, CrossEntropy, EntropyReduction, MixedEntropy

SCENE, CANDIDATES = 3, 14
CAMERA = Camera(height=24, width=24)
# One method with samples, since each compiles a planner.
RUN = ("cross-entropy", "farthest", "random", "oracle")


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
    return run_scene(small_study(), SCENE, RUN)


def chosen(study, method):
    """Candidates of a method's first run."""
    places = np.asarray(study.candidates.poses().position)
    return [int(np.linalg.norm(places - view["position"], axis=1).argmin()) for view in method["views"]]


def test_a_record_is_json_and_holds_every_method():
    record = json.loads(json.dumps(whole_record(), allow_nan=False))
    assert record == whole_record()
    assert list(record["methods"]) == list(RUN)
    assert (record["scene"], record["framing"]) == (SCENE, "close-up")
    assert record["label"] == int(pyramid_scene(Split.TEST, SCENE).label)
    places = {tuple(place) for place in np.asarray(small_study().candidates.poses().position).tolist()}
    for name, method in record["methods"].items():
        positions = {tuple(view["position"]) for view in method["views"]}
        assert len(positions) == 3
        assert positions <= places
        assert np.shape(method["log_p"]) == (8 if name == "random" else 1, 3, 5)
        assert np.shape(method["pixels"]) == np.shape(method["log_p"])[:2]
        np.testing.assert_allclose(np.exp(method["log_p"]).sum(axis=-1), 1.0, atol=1e-5)
        # Diagnostics stand at the view that was chosen by them.
        ranks, rough = method["rank_correlation"], method["roughness"]
        assert ranks[0] is rough[0] is None
        assert all(value is None or -1 <= value <= 1 for value in ranks)
        assert [value is not None and value > 0 for value in rough] == [False] + [name == "cross-entropy"] * 2
    assert len({tuple(run) for run in record["methods"]["random"]["pixels"]}) > 1


def test_the_first_view_is_that_of_all_methods_and_shows_no_pattern_but_something():
    study, record = small_study(), whole_record()
    assert {chosen(study, method)[0] for method in record["methods"].values()} == {record["first"]}
    pyramid, poses = pyramid_scene(Split.TEST, SCENE), study.candidates.poses()
    _, clouds = scan_cue(pyramid, CAMERA, poses)
    pixels = np.asarray(jnp.sum(pyramid.on_cue(clouds.points) & clouds.mask, axis=-1))
    assert pixels[record["first"]] == 0 < int(clouds.count[record["first"]])
    for method in record["methods"].values():
        np.testing.assert_allclose(method["pixels"][0], pixels[chosen(study, method)], atol=1)
    outward = -np.asarray(pyramid.solid.rotation)[:, 2]
    angle = np.degrees(np.arccos(np.asarray(poses.position[record["first"]]) @ outward / 2.5))
    assert record["angle"] == pytest.approx(angle, abs=0.05)


def test_each_method_has_its_search_and_score():
    study = small_study()
    scene = study.scene(SCENE)
    planners = {method: study.planner(method, scene) for method in (*study.methods, *study.extra_methods)}
    scores = {"entropy": EntropyReduction, "mixed": MixedEntropy}
    for method, planner in planners.items():
        plain = method in ("coverage", "farthest", "uncertainty", "random")
        assert type(planner.acquisition) is (Coverage if plain else scores.get(method, CrossEntropy))
        assert plain or planner.acquisition.num_points == 100
    assert isinstance(planners["oracle"].search, OracleView)
    assert isinstance(planners["gradient-2dof"].search, GradientSearch)
    assert isinstance(planners["tie-break"].search, TieBreakSearch)
    assert isinstance(planners["tie-break"].search.second, Coverage)


def test_the_oracle_values_true_scans():
    study, run = small_study(), whole_record()["methods"]["oracle"]
    scene, visited = study.scene(SCENE), chosen(small_study(), run)
    observations = replay(study, scene, run)[1][1]
    values = study.planner("oracle", scene).propose(observations, jax.random.key(3)).values
    thinned = limit_capacity(observations.cloud, 100)
    p = np.exp(np.asarray(study.classifier(thinned), np.float64))
    for candidate in {0, 5, 7} - {*visited[:2]}:
        q = np.asarray(study.classifier(concatenate(thinned, scene.task.scans[candidate])), np.float64)
        assert values[candidate] == pytest.approx(-np.sum(p * q), rel=1e-4)
    assert int(values.argmax()) == visited[2]


def test_answers_are_the_classifiers_of_all_that_was_seen():
    study, run = small_study(), whole_record()["methods"]["cross-entropy"]
    scene = study.scene(SCENE)
    for log_p, candidate, (scan, observations) in zip(
        run["log_p"][0], chosen(study, run), replay(study, scene, run), strict=True
    ):
        np.testing.assert_array_equal(scan.points, scene.task.scans[candidate].points)
        np.testing.assert_allclose(log_p, study.classifier(observations.cloud), atol=1e-5)
    # A search by gradient leaves the candidates. There the sensor scans anew, with noise.
    between = look_at([[0.3, 1.0, 2.2]])
    scan = study.sensor(scene)(between[0], jax.random.key(0))
    _, clouds = scan_cue(scene.task.class_object, CAMERA, between)
    np.testing.assert_array_equal(scan.mask, clouds.mask[0])
    np.testing.assert_allclose(scan.points, clouds.points[0], atol=0.1)


@pytest.mark.parametrize("kind", [HouseholdStudy, PyramidStudy])
def test_the_first_view_can_be_one_after_which_the_classifier_is_wrong(kind):
    """For a pyramid it must not show the pattern either."""
    study = small_study(kind=kind, first=FirstView.MISCLASSIFIED)
    scene = study.scene(SCENE)

    def right_where(is_right, cloud):
        mean = jnp.sum(jnp.where(cloud.mask[:, None], cloud.points, 0.0), axis=0)
        guess = jnp.where(is_right(mean), scene.task.label, (scene.task.label + 1) % len(kind.objects.classes))
        return jax.nn.log_softmax(9.0 * jax.nn.one_hot(guess, len(kind.objects.classes)))

    for axis in range(3):
        classifier = functools.partial(right_where, lambda mean, axis=axis: mean[axis] > 0)
        first = dataclasses.replace(study, classifier=classifier).first_view(scene)
        points, _ = scene.task.scans[first].to_numpy()
        assert points[:, axis].mean() <= 0
        assert kind is HouseholdStudy or int(scene.task.cue_pixels[first]) == 0
    always_right = functools.partial(right_where, lambda mean: True)
    with pytest.raises(InputError, match="shows enough of"):
        dataclasses.replace(study, classifier=always_right).first_view(scene)


def test_first_views_of_trucks_are_random_and_grouped_by_what_they_show():
    """Random first views: `test_the_first_view_shows_enough`."""
    assert TruckStudy.first_view is Study.first_view
    for pixels, group in ((0, "first view without cargo"), (3, "first view with cargo")):
        assert TruckStudy.group({"methods": {"farthest": {"pixels": [[pixels, 400]]}}}) == group


@pytest.mark.parametrize(
    ("kind", "methods"),
    [(HouseholdStudy, ("farthest", "oracle")), pytest.param(TruckStudy, None, marks=pytest.mark.slow)],
)
def test_records_tables_charts_and_pictures(kind, methods, tmp_path):
    """If the whole object tells its class, no pixels are counted."""
    record = json.loads(json.dumps(run_scene(small_study(kind=kind), SCENE, methods), allow_nan=False))
    assert list(record["methods"]) == list(methods or kind.methods)
    assert record["label"] == SCENE % len(kind.objects.classes)
    for method in record["methods"].values():
        assert np.shape(method["log_p"])[1:] == (3, 10)
        assert bool(method["pixels"]) == bool(kind.cue)
        assert kind.cue or method["rank_correlation"] == [None] * 3
    table = results([record], kind)
    assert ("seen" in {*table["quantity"]}) == bool(kind.cue)
    assert kind.title in summary(table, kind)
    assert chart(table, kind)[:4] == b"\x89PNG"
    # Methods of one's own are pictured if there are no others.
    for methods in (record["methods"], {"mine:own": record["methods"]["farthest"]}):
        check_picture(record | {"methods": methods}, small_study(kind=kind), tmp_path)


def check_picture(record, study, folder):
    (path,) = write_pictures([record], study, folder, pixels=24)
    assert path.name == f"scene_{record['scene']:04d}.png"
    with Image.open(path) as image:
        assert np.asarray(image.convert("L")).std() > 5


def box_files(folder, *names):
    for name in names:
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        trimesh.creation.box((1.0, 0.5, 0.25)).export(file)


def test_meshes_in_place_of_procedural_objects(tmp_path):
    box_files(tmp_path, "chair/a.off", "desk/b.obj")
    study = small_study(kind=HouseholdStudy, meshes=class_meshes(tmp_path, HOUSEHOLD))
    assert study.num_scenes == 2
    record = run_scene(study, 1, ("farthest",))
    assert (record["label"], record["name"]) == (HOUSEHOLD.index("desk"), "desk b")
    points = study.scene(1).task.scans[record["first"]].to_numpy()[0]
    # A box of sides 2.5, 1.25 and 0.625, with noise of 0.01.
    away = np.abs(np.abs(points) - [1.25, 0.625, 0.3125]).min(axis=1)
    assert away.max() < 0.06
    check_picture(record, study, tmp_path)
    with pytest.raises(InputError, match="no scene 2: the study has 2 meshes"):
        run_scene(study, 2)
    with pytest.raises(InputError, match="2 meshes of cargo and 0 of trucks: give both, or none"):
        small_study(kind=TruckStudy, meshes=class_meshes(tmp_path, HOUSEHOLD))


def test_a_network_of_ones_own_takes_the_place_of_the_shipped_one(tmp_path):
    shapes = eqx.filter_eval_shape(InvariantClassifier, 5, jax.random.key(0), groups=(20, 8))
    network = jax.tree.map(lambda leaf: jnp.full(leaf.shape, 0.25), shapes)
    save_checkpoint(network, tmp_path / "mine.safetensors")
    box_files(tmp_path, "mango/mango_001/Scan/Scan.obj")
    settings = {"meshes": tmp_path, "classifier": tmp_path / "mine.safetensors"}
    (study,) = OmniObject3DStudy.configured("screened", 2, True, **settings).values()
    assert study.scene(0).name == "mango mango_001"
    assert (study.classifier.num_points, study.imagined_classifier.num_points) == OmniObject3DStudy.network_points
    np.testing.assert_array_equal(study.classifier.network.head[1].bias, network.head[1].bias)
    with pytest.raises(InputError, match=r"knows 5 classes; the study has 10: bathtub, bed"):
        HouseholdStudy.configured("screened", 2, True, classifier=tmp_path / "mine.safetensors")
    for name, word in (("meshes", "--classifier FILE"), ("classifier", "--meshes FOLDER.* lemon, mango")):
        with pytest.raises(InputError, match=f"nothing ships for the study omniobject3d: give {word}"):
            OmniObject3DStudy.configured("screened", 2, True, **{name: settings[name]})
