"""The heat study on a small scale, and its measures on records made by hand."""

import functools
import json

import numpy as np
import pytest
import trimesh
from PIL import Image

import jaxnbv as nbv
from jaxnbv.checks import InputError
from jaxnbv.readers.class_meshes import mesh_files
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import TriangleMesh
from jaxnbv.search import HalvingSearch
from jaxnbv.studies.engine.pictures import write_pictures
from jaxnbv.studies.engine.run import replay, run_scene
from jaxnbv.studies.heat import HeatStudy, Truth, heat_problem
from jaxnbv.studies.scenes import heat_scene
from jaxnbv.tasks import coldest_point
from jaxnbv.tasks import heat as heat_task

# The other planners have the same structure, and each would compile as long again.
RUN = ("heat", "farthest")
VIEWS = 2


def small_study(**settings):
    model = nbv.GeometricSPSR(lengthscale=0.05, truncation=8)
    small = {"views": VIEWS, "num_candidates": 12, "num_samples": 3, "sampler": SurfaceSampler(model)}
    few = {"grid_resolution": 20, "capacity": 900, "num_points": 200, "imagined_rays": 6, "true_grid": nbv.Grid(48)}
    return HeatStudy(**(small | few | settings))


@pytest.fixture(autouse=True)
def coarse_truth(monkeypatch):
    monkeypatch.setattr(heat_task, "_LONGEST_EDGE", 0.1)
    # Without worker processes.
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")


@functools.cache
def desk():
    return run_scene(small_study(), 0, RUN)


@pytest.fixture
def record(coarse_truth):
    return desk()


def test_a_record_is_json_and_holds_every_method(record):
    assert json.loads(json.dumps(record, allow_nan=False)) == record
    assert (record["scene"], record["name"], list(record["methods"])) == (0, "desk", list(RUN))
    for run in record["methods"].values():
        assert len({tuple(view["position"]) for view in run["views"]}) == VIEWS
        assert [len(values) for values in (run["reached"], run["steps"])] == [VIEWS, VIEWS - 1]
        assert all(0 < share <= 1 for share in run["reached"])


def test_the_first_view_sees_the_heat_source(record):
    study = small_study()
    for method in RUN:
        points, _ = replay(study, study.scene(0), record["methods"][method])[0][1].cloud.to_numpy()
        assert np.linalg.norm(points - np.asarray(heat_scene(0).source), axis=1).min() <= 0.1


def test_estimates_are_those_of_the_clouds(record):
    study = small_study()
    scene = study.scene(0)
    truth, heat = study.truth(scene), heat_problem(scene)
    low, high = truth.temperatures.min(), truth.temperatures.max()
    near = truth.points[truth.temperatures <= low + 0.01 * (high - low)]
    assert record["truth"] == {"point": truth.coldest.tolist(), "temperature": low, "hottest": high}
    assert coldest_point(truth.mesh, heat).temperature == low
    run = record["methods"]["heat"]
    for view, (_, observations) in enumerate(replay(study, scene, run)):
        for name, estimate in run["estimates"].items():
            expected = coldest_point(observations.cloud, heat, reached_only=name == "reached")
            assert estimate["points"][view] == expected.point.tolist()
            assert estimate["temperatures"][view] == expected.temperature
            distance = np.linalg.norm(near - expected.point, axis=1).min()
            assert estimate["distances"][view] == pytest.approx(distance)
            assert estimate["distances"][view] <= np.linalg.norm(truth.coldest - expected.point)


def test_the_coldest_points_are_those_within_a_hundredth_of_the_range():
    points = np.eye(3)
    mesh = TriangleMesh(points, np.arange(3)[None], nbv.Frame())
    truth = Truth(mesh, points, np.array([1.0, 1.009, 2.0]))
    np.testing.assert_array_equal(truth.region, points[:2])
    np.testing.assert_array_equal(truth.coldest, points[0])


def test_methods_differ_in_what_they_seek_and_how_they_search():
    study = small_study()
    planners = {method: study.planner(method, study.scene(0)) for method in study.methods}
    scores = {method: planner.acquisition for method, planner in planners.items()}
    searches = [nbv.DiscreteSearch, nbv.DiscreteSearch, HalvingSearch, nbv.DiscreteSearch, nbv.FarthestView]
    assert [type(planners[method].search) for method in study.methods[:5]] == searches
    assert [scores[m].utility.reached_only for m in study.methods[:3]] == [False, True, False]
    assert all(isinstance(scores[method], nbv.Coverage) for method in study.methods[3:])
    assert scores["heat"].num_points == 200


def test_the_picture_shows_every_cloud_beside_the_truth(record, tmp_path):
    (path,) = write_pictures([record], small_study(), tmp_path / "pictures", pixels=80)
    assert path.name == "scene_0000.png"
    image = np.asarray(Image.open(path).convert("RGB")).astype(int)
    assert image.std() > 5
    # The green star of the true coldest point, in the truth and in the two views of both methods.
    green = np.abs(image - [0x00, 0x9E, 0x73]).sum(axis=-1) < 30
    assert green.sum() > 5 * 20


def test_a_folder_of_meshes_gives_the_scenes(tmp_path):
    for radius, name in ((1.0, "a.obj"), (0.5, "b.ply")):
        trimesh.creation.icosphere(3, radius).export(tmp_path / name)
    study = HeatStudy(meshes=mesh_files(tmp_path))
    scenes = [study.scene(index) for index in range(2)]
    assert [scene.name for scene in scenes] == ["a", "b"]
    for scene in scenes:
        assert 1.22 < np.linalg.norm(scene.task) < 1.26
    assert not np.allclose(scenes[0].task, scenes[1].task)
    truth = study.truth(scenes[0])
    # The coldest end of a ball is opposite to the heated one.
    opposite = -np.asarray(scenes[0].task)
    assert np.linalg.norm(truth.coldest - opposite) < 0.3
    with pytest.raises(InputError, match="no scene 2"):
        study.scene(2)


def test_measures_are_of_the_estimates():
    """Estimates among warmed points are a tenth nearer and equally warm."""
    run = {
        "steps": [{"value": 0.5, "seconds": 10.0}, {"value": 0.0, "seconds": 12.0}],
        "estimates": {
            name: {"distances": [1.0 - less, 0.4 - less], "temperatures": [0.9, 0.0]}
            for name, less in (("all", 0.0), ("reached", 0.1))
        },
    }
    record = {"truth": {"temperature": 0.1}, "methods": {"heat": run, "random": run}}
    of = {measure.name: measure.compute for measure in HeatStudy.measures}
    assert of["distance, all"](record, "heat") == [1.0, 0.4]
    assert of["distance, reached"](record, "heat") == pytest.approx([0.9, 0.3])
    # An error counts in either direction.
    assert of["error, all"](record, "random") == pytest.approx([0.8, 0.1])
    # Steps without a view of positive value are counted for methods that seek cold.
    assert (of["saturated"](record, "heat"), of["saturated"](record, "random")) == ({2: 0.0, 3: 1.0}, {})
    assert of["seconds"](record, "heat") == {"median": 12.0}
