"""The heat study on a small scale."""

import json

import numpy as np
import pytest
import trimesh
from PIL import Image

import jaxnbv as nbv
from jaxnbv.checks import InputError
from jaxnbv.imagination import Imagination
from jaxnbv.scanning import TriangleMesh
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.studies.engine.pictures import write_pictures
from jaxnbv.studies.heat.pictures import tiles
from jaxnbv.studies.heat.study import HeatStudy, Truth, heat_problem
from jaxnbv.studies.scenes import heat_scene
from jaxnbv.tasks import coldest_point
from jaxnbv.tasks import heat as heat_task

# The other planners are put together in the same way, and compile as long again.
RUN = ("heat", "heat-halving", "farthest")
CANDIDATES, VIEWS = 12, 3


def small_study(**settings):
    model = nbv.GeometricSPSR(lengthscale=0.05, truncation=8)
    small = {
        "views": VIEWS,
        "num_candidates": CANDIDATES,
        "num_samples": 3,
        "imagination": Imagination(model),
        "grid_resolution": 20,
    }
    few = {"capacity": 900, "num_points": 200, "imagined_rays": 6, "true_grid": nbv.Grid(48)}
    return HeatStudy(**(small | few | settings))


@pytest.fixture(autouse=True)
def coarse_truth(monkeypatch):
    monkeypatch.setattr(heat_task, "_LONGEST_EDGE", 0.1)
    # No worker processes.
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")


_records: dict = {}


@pytest.fixture
def record():
    if not _records:
        _records["desk"] = small_study().run_scene(0, RUN)
    return _records["desk"]


def test_a_record_is_json_and_holds_every_method(record):
    assert json.loads(json.dumps(record, allow_nan=False)) == record
    assert (record["scene"], record["name"], list(record["methods"])) == (0, "desk", list(RUN))
    for run in record["methods"].values():
        assert len({tuple(view["position"]) for view in run["views"]}) == VIEWS
        assert [len(values) for values in (run["reached"], run["steps"])] == [VIEWS, VIEWS - 1]
        assert all(0 < share <= 1 for share in run["reached"])
    assert HeatStudy.methods == (
        "heat",
        "heat-reached",
        "heat-halving",
        "coverage",
        "farthest",
        "uncertainty",
        "random",
    )


def test_the_first_view_sees_the_heat_source(record):
    study = small_study()
    for method in RUN:
        points, _ = study.seen(study.scene(0), record["methods"][method])[0][1].cloud.to_numpy()
        assert np.linalg.norm(points - np.asarray(heat_scene(0).source), axis=1).min() <= 0.1


def candidate_at(positions, view):
    distance = np.linalg.norm(positions - view["position"], axis=1)
    assert distance.min() < 1e-5
    return int(np.argmin(distance))


def test_the_farthest_view_is_that_of_a_plain_search(record):
    positions = np.asarray(sphere_candidates(CANDIDATES, 3.0).position)
    taken = [candidate_at(positions, view) for view in record["methods"]["farthest"]["views"]]
    for view in range(1, VIEWS):
        distance = np.linalg.norm(positions[:, None] - positions[taken[:view]], axis=-1).min(axis=1)
        assert distance[taken[view]] == pytest.approx(distance.max())


def test_estimates_are_those_of_the_clouds(record):
    study = small_study()
    scene = study.scene(0)
    truth, heat = study.truth(scene), heat_problem(scene)
    low, high = truth.temperatures.min(), truth.temperatures.max()
    near = truth.points[truth.temperatures <= low + 0.01 * (high - low)]
    assert record["truth"] == {"point": truth.coldest.tolist(), "temperature": low, "hottest": high}
    assert coldest_point(truth.mesh, heat).temperature == low
    run = record["methods"]["heat"]
    for view, (_, evidence) in enumerate(study.seen(scene, run)):
        for name, found in run["estimates"].items():
            expected = coldest_point(evidence.cloud, heat, reached_only=name == "reached")
            assert found["points"][view] == expected.point.tolist()
            assert found["temperatures"][view] == expected.temperature
            distance = np.linalg.norm(near - expected.point, axis=1).min()
            assert found["distances"][view] == pytest.approx(distance)
            assert found["distances"][view] <= np.linalg.norm(truth.coldest - expected.point)


def test_the_coldest_points_are_those_within_a_hundredth_of_the_range():
    points = np.eye(3)
    mesh = TriangleMesh(points, np.arange(3)[None], nbv.Frame())
    truth = Truth(mesh, points, np.array([1.0, 1.009, 2.0]))
    np.testing.assert_array_equal(truth.region, points[:2])
    np.testing.assert_array_equal(truth.coldest, points[0])


def test_halving_finds_the_second_view_of_the_full_search(record):
    """Both start from the same view, so that it is chosen from the same evidence and samples."""
    second = [np.round(record["methods"][method]["views"][1]["position"], 4).tolist() for method in RUN[:2]]
    assert second[0] == second[1]


def test_methods_differ_in_what_they_seek():
    study = small_study()
    scores = {method: study.planner(method, study.scene(0)).acquisition for method in study.methods}
    assert [scores[m].utility.reached_only for m in study.methods[:3]] == [False, True, False]
    assert all(isinstance(scores[method], nbv.Coverage) for method in study.methods[3:])
    assert scores["heat"].num_points == 200


def test_bad_settings_are_refused():
    for views in (1, 13):
        with pytest.raises(InputError, match="at least two views"):
            small_study(views=views)
    with pytest.raises(InputError, match="unknown methods: gradient; choose from heat"):
        small_study().run_scene(0, ("gradient", "heat"))


def test_the_picture_shows_every_cloud_beside_the_truth(record, tmp_path):
    (path,) = write_pictures([record], small_study(), tmp_path / "pictures", tiles, pixels=80)
    assert path.name == "scene_0000.png"
    image = np.asarray(Image.open(path).convert("RGB")).astype(int)
    assert image.std() > 5
    # The green star of the true coldest point, in the truth and in all three views of both methods that are shown.
    green = np.abs(image - [0x00, 0x9E, 0x73]).sum(axis=-1) < 30
    assert green.sum() > 7 * 20


def test_a_folder_of_meshes_gives_the_scenes(tmp_path):
    for radius, name in ((1.0, "a.obj"), (0.5, "b.ply")):
        trimesh.creation.icosphere(3, radius).export(tmp_path / name)
    study = HeatStudy(meshes=tmp_path)
    scenes = [study.scene(index) for index in range(2)]
    assert [scene.name for scene in scenes] == ["a.obj", "b.ply"]
    for scene in scenes:
        assert 1.22 < np.linalg.norm(scene.task) < 1.26
    assert not np.allclose(scenes[0].task, scenes[1].task)
    truth = study.truth(scenes[0])
    # Of a ball heated at one place the other end is coldest.
    opposite = -np.asarray(scenes[0].task)
    assert np.linalg.norm(truth.coldest - opposite) < 0.3
    with pytest.raises(InputError, match="no scene 2"):
        study.scene(2)
